"""Collisions in C written by hand, with SIMD: what the graphs compute, twenty to fifty times as fast."""

from impactopt.collision.native.source import (
    native_collision,
    native_differences,
    native_gradient,
    native_jacobian,
)

__all__ = ["native_collision", "native_differences", "native_gradient", "native_jacobian"]
