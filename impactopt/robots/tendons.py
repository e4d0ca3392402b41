"""Tendons: bounds on weighted sums of joint angles, as MuJoCo's limited fixed tendons are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError
from impactopt.robots.build import joint_index
from impactopt.robots.couplings import Coupling

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Tendon:
    """Bounds on a weighted sum of joint angles: lower <= sum of coefficient x angle <= upper.

    name : of the tendon.  coefficients : by joint, without unit.  lower, upper [rad] : of the sum.
    """

    name: str
    coefficients: Mapping[str, float]
    lower: float
    upper: float

    def __str__(self) -> str:
        sum_of = " ".join(f"{factor:+g} {joint}" for joint, factor in self.coefficients.items())
        return f"{self.name}: {self.lower:g} <= {sum_of} <= {self.upper:g}"

    def without(self, locked: Mapping[str, float], couplings: Mapping[str, Coupling]) -> Tendon:
        """The same bounds on the remaining joints: locked ones, at an angle [rad], are moved to the bounds,
        followers are replaced by their leaders.
        """
        constant, left = 0.0, dict[str, float]()
        for joint, factor in self.coefficients.items():
            if joint in locked:
                constant += factor * locked[joint]
                continue
            leader, ratio, offset = couplings.get(joint, (joint, 1.0, 0.0))
            constant += factor * offset
            left[leader] = left.get(leader, 0.0) + factor * ratio
        left = {joint: factor for joint, factor in left.items() if factor}
        return replace(self, coefficients=left, lower=self.lower - constant, upper=self.upper - constant)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranges:
    """Ranges of a robot's n joints and, after them, of its tendons.

    names : of both.  lower, upper (n + tendons,) [rad].  matrix (tendons, n) : coefficients of the tendons.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    matrix: Array

    @classmethod
    def of(cls, joints: Sequence[str], lower: Array, upper: Array, tendons: Sequence[Tendon]) -> Ranges:
        """Ranges of joints (n,) and tendons."""
        return cls(
            names=(*joints, *(f"tendon {tendon.name}" for tendon in tendons)),
            lower=np.append(lower, [tendon.lower for tendon in tendons]),
            upper=np.append(upper, [tendon.upper for tendon in tendons]),
            matrix=np.array(
                [[tendon.coefficients.get(joint, 0.0) for joint in joints] for tendon in tendons]
            ).reshape(-1, len(joints)),
        )

    def positions(self, angles: Array) -> Array:
        """(..., n + tendons) [rad] of joint angles (..., n)."""
        return np.concatenate([angles, angles @ self.matrix.T], axis=-1)

    def excess(self, angles: Array) -> tuple[str, float]:
        """Name and excess [rad] of the joint or tendon farthest out of its range, at joint angles (k, n)."""
        at = self.positions(angles)
        most = np.maximum(at - self.upper, self.lower - at).max(axis=0)
        worst = int(np.argmax(most))
        return self.names[worst], float(most[worst])


def check_tendons(tendons: Sequence[Tendon], joints: Sequence[str]) -> None:
    """InputError for a tendon with unknown joints, an empty range, or no joints."""
    for tendon in tendons:
        what = f"tendon {tendon.name!r}"
        for joint in tendon.coefficients:
            joint_index(joints, joint, what)
        if not tendon.lower < tendon.upper:
            raise InputError(f"{what}: its range is {tendon.lower:g} to {tendon.upper:g}; give lower < upper")
        if not tendon.coefficients:
            raise InputError(f"{what} is out of its range at the angles of its locked joints; change those")
