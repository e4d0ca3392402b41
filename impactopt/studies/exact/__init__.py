"""The frozen collision solved exactly: what the tests and benches measure steps by."""

from impactopt.studies.exact.solution import ExactCollision

__all__ = ["ExactCollision"]
