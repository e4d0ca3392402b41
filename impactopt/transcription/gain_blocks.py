"""Gains that a plan chooses, in the functions that have them."""

from __future__ import annotations

from typing import Any

import casadi as ca

__all__ = ["Joints", "chosen_gains"]

Joints = tuple[tuple[int, ...], ...]  # of each factor, their places among the gains


def chosen_gains(stiffness: Any, damping: Any, logs: Any, chosen: Joints) -> tuple[Any, Any]:
    """Stiffness times the factors of ``chosen``, whose logarithms are ``logs``; damping times their roots."""
    stiffness, damping = ca.SX(stiffness), ca.SX(damping)
    for k, joints in enumerate(chosen):
        for joint in joints:
            stiffness[joint] *= ca.exp(logs[k])
            damping[joint] *= ca.exp(logs[k] / 2)
    return stiffness, damping
