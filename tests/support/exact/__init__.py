"""The frozen collision solved exactly: what the tests and benches measure steps by."""

from support.exact.solution import ExactCollision

__all__ = ["ExactCollision"]
