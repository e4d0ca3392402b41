"""What a re-simulation is given and what it gives back: numbers only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError

Array = NDArray[np.float64]
PHASES = ("swing", "collision", "follow")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The target and its contact: a free mass behind a spring-damper that damps in compression only.

    point (3,) [m], normal (3,): where the target's surface is at rest, and the way it is pushed; stiffness
    [N/m]; damping [N s/m]; mass [kg]; striker: frame of the model that hits; soles: frames of the model that
    are held, with their polygons (k, 2) [m]; polygon (k, 2) [m]: support polygon on the ground,
    counter-clockwise.
    """

    point: Array
    normal: Array
    stiffness: float
    damping: float
    mass: float
    striker: str
    soles: tuple[str, ...]
    polygon: Array


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Histories over ``time`` (k,) [s] of a re-simulated motion, and when contact began and ended.

    force (k,) [N]; target_speed, hand_speed (k,) [m/s]; demand (k, n) [N m] servo torque before saturation;
    torque (k, n) after it; ground (k, 6) ground wrench about the world's origin [N, N m];
    sole_normal (k, soles) [N], negative where the ground would have to pull; drift (k,) [m] of
    the sole that moved most; q (k, nq). contact_start, contact_end [s]: nan if the target was not hit.
    """

    engine: str
    time: Array
    q: Array
    force: Array
    target_speed: Array
    hand_speed: Array
    demand: Array
    torque: Array
    ground: Array
    sole_normal: Array
    drift: Array
    contact_start: float
    contact_end: float
    mass: float

    def phase(self) -> NDArray[np.intp]:
        """0 swing, 1 collision, 2 follow-through, by the contact that happened."""
        start = self.contact_start if np.isfinite(self.contact_start) else np.inf
        end = self.contact_end if np.isfinite(self.contact_end) else np.inf
        return np.asarray((self.time >= start).astype(int) + (self.time >= end).astype(int))

    def summary(self, *, torque_limit: Array, polygon: Array, planned_impulse: float) -> dict[str, Any]:
        """Impulse, force, margins and demand by phase, normal force, drift; keys as in ``summary.json``."""
        if not np.isfinite(self.contact_start):
            raise InputError("the simulated motion never touched the target")
        phase = self.phase()
        impulse = float(self.mass * self.target_speed[-1])
        out: dict[str, Any] = {
            "engine": self.engine,
            "impulse_Ns": impulse,
            "impulse_error_pct": 100 * (impulse / planned_impulse - 1),
            "peak_force_N": float(self.force.max()),
            "contact_ms": 1e3 * (self.contact_end - self.contact_start),
            "hand_speed_m_s": float(self.hand_speed[phase == 0][-1]),
        }
        ratio = np.abs(self.demand / torque_limit).max(axis=1)
        out["torque_ratio"] = {
            n: float(ratio[phase == k].max()) for k, n in enumerate(PHASES) if (phase == k).any()
        }
        if len(polygon):
            zmp = np.stack([-self.ground[:, 4], self.ground[:, 3]], axis=1) / self.ground[:, 2:3]
            edge = np.roll(polygon, -1, axis=0) - polygon
            inward = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
            inside = (zmp @ inward.T - (inward * polygon).sum(axis=1)).min(axis=1)
            out["zmp_margin_m"] = {
                n: float(inside[phase == k].min()) for k, n in enumerate(PHASES) if (phase == k).any()
            }
            out["min_normal_force_N"] = float(self.sole_normal.min())  # of any one sole
            out["sole_drift_mm"] = 1e3 * float(self.drift.max())
        return out
