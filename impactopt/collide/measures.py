"""Measures that a sweep of collisions can put into its table, and the outputs that each needs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collide.contact_states import States
from impactopt.contact.targets import Target
from impactopt.errors import InputError, did_you_mean
from impactopt.kinematics.support import margin, zmp

__all__ = ["MEASURES", "Blow", "Measure", "chosen"]

Array = NDArray[np.float64]

LEAST_WEIGHT = 1.0  # [N] on the ground; with less there is no ZMP


@dataclass(frozen=True, kw_only=True, eq=False)
class Blow:
    """N collisions: outputs by name as of `SymbolicModel.batch`, their states, torque limits (N, n) or (1, n)
    [N m], and the support polygon (k, 2) [m]."""

    found: Mapping[str, Array]
    states: States
    torque_limit: Array
    velocity_limit: Array
    polygon: Array


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A column of the table: the outputs of a collision that it takes, what it is, and how it is had."""

    outputs: tuple[str, ...]
    what: str
    of: Callable[[Blow], Array]


def _torque_ratio(blow: Blow) -> Array:
    demand = np.abs(blow.found["demand"])
    return np.asarray((demand.max(axis=1) / blow.torque_limit).max(axis=1))


def _velocity_ratio(blow: Blow) -> Array:
    joints = np.abs(blow.states.v[:, -blow.velocity_limit.size :])
    return np.asarray((joints / blow.velocity_limit).max(axis=1))


def _zmp_margin(blow: Blow) -> Array:
    ground = blow.found["ground_wrench"]
    flat = ground.reshape(-1, 6)
    out = np.full(len(flat), -np.inf)
    stands = flat[:, 2] > LEAST_WEIGHT
    out[stands] = margin(blow.polygon, zmp(flat[stands]))
    return out.reshape(ground.shape[:2]).min(axis=1)


MEASURES: Mapping[str, Measure] = {
    "impulse_Ns": Measure(
        outputs=("impulse",), what="delivered to the target", of=lambda b: b.found["impulse"]
    ),
    "peak_force_N": Measure(
        outputs=("peak_force",), what="largest contact force", of=lambda b: b.found["peak_force"]
    ),
    "contact_ms": Measure(
        outputs=("duration",), what="from contact to separation", of=lambda b: 1e3 * b.found["duration"]
    ),
    "energy_J": Measure(outputs=("energy",), what="given to the target", of=lambda b: b.found["energy"]),
    "torque_ratio": Measure(
        outputs=("demand",),
        what="largest torque demand over its joint's limit, at every millisecond of contact",
        of=_torque_ratio,
    ),
    "zmp_margin_m": Measure(
        outputs=("ground_wrench",),
        what="least distance of the ZMP from the soles' hull, positive inside, at every millisecond of "
        "contact; minus infinity where the soles would have to pull",
        of=_zmp_margin,
    ),
    "sole_force_N": Measure(
        outputs=("sole_wrench",),
        what="least vertical force of the ground on one sole, at every millisecond of contact",
        of=lambda b: b.found["sole_wrench"][..., 2].min(axis=(1, 2)),
    ),
    "freeze_error_pct": Measure(
        outputs=("freeze_error",),
        what="what freezing may have cost of the impulse, as an estimate; 0 of full dynamics, nan of models "
        "whose error is another",
        of=lambda b: 100 * b.found["freeze_error"],
    ),
    "hand_speed_m_s": Measure(
        outputs=(), what="of the striking point along the normal, at contact", of=lambda b: b.states.speed
    ),
    "effective_mass_kg": Measure(
        outputs=(),
        what="of the held robot at the striking point along the normal",
        of=lambda b: b.states.mass,
    ),
    "velocity_ratio": Measure(
        outputs=(), what="largest joint speed at contact over its limit", of=_velocity_ratio
    ),
}


def chosen(names: Iterable[str], target: Target) -> dict[str, Measure]:
    """Measures by name; of a target its results too: target_speed_m_s, target_depth_m, target_broken.

    Raises
    ------
    InputError : a name that there is not.
    """
    results = {f"target_{name}": _result(k) for k, name in enumerate(target.result_names)}
    known = {**MEASURES, **results}
    out = {}
    for name in names:
        if name not in known:
            raise InputError(
                f"there is no output {name!r}{did_you_mean(name, known)} of a sweep of collisions; there are "
                + ", ".join(known)
            )
        out[name] = known[name]
    if not out:
        raise InputError(f"outputs: name at least one of {', '.join(known)}")
    return out


def _result(k: int) -> Measure:
    def of(blow: Blow) -> Array:
        result: Any = blow.found["target_result"]
        return np.asarray(result[:, k])

    return Measure(outputs=("target_result",), what="of the target after the blow", of=of)
