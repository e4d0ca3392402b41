"""Collisions of rows that differ in numbers only: one robot, one model, one posture at contact."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.collide.contact_states import ContactStates, Posture, States
from impactopt.collide.single_collision import NOT_ENDED, AtContact, Blow, Measure
from impactopt.collision import Collision, CollisionModel
from impactopt.collision.checks import FREEZE_ERROR, too_large
from impactopt.collision.outputs import HISTORIES
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError
from impactopt.files.problem_file import ProblemFile
from impactopt.files.problem_file.toml import Place
from impactopt.sweeps.collision_keys import SERVO, setting_of

__all__ = ["AlikeCollisions"]

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Numbers = Mapping[Place, Array]  # columns of numbers, by their keys' places

_ROWS, _WITH_HISTORIES = 8192, 512  # rows at a time: histories are large
_TOLERANCE = 1e-4  # relative, of the full dynamics' impulse
NO_NUMBER = (
    "the collision has no finite numbers: its steps are unstable here, or what holds the robot cannot be "
    "told apart"
)
TOO_STIFF = "the contact is too stiff for the steps of its law: {:.1g} of the impulse would be left out"


@dataclass(frozen=True, kw_only=True, eq=False)
class AlikeCollisions:
    """Batch of collisions that differ in numbers and hit points only.

    file, section : problem and [at_contact], with the values of keys that make the structure.
    model, states, measures : what collides, from where, and what of it is asked for.
    """

    file: ProblemFile
    section: AtContact
    model: CollisionModel
    states: ContactStates
    measures: Mapping[str, Measure]

    def posture(self, point: tuple[float, ...] | None = None) -> Posture | str:
        """The posture that rows with this hit point (3,) [m] start from, None being the problem's own; or why
        there is none.

        Raises
        ------
        InputError : as of `ContactStates.posture`.
        """
        at = tuple(self.file.content.problem.point) if point is None else point
        return self.states.posture(self.section.posture, self.section.result, at)

    def __call__(self, numbers: Numbers, count: int, threads: int | None) -> dict[str, NDArray[Any]]:
        """Columns of `count` rows by measure, and ``reason``."""
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.measures}
        out["reason"] = np.full(count, "", dtype=object)
        for point, rows in self._points(numbers, count):
            posture = self.posture(point)
            if isinstance(posture, str):
                out["reason"][rows] = posture
                continue
            for begin in range(0, len(rows), self._together):
                some = rows[begin : begin + self._together]
                own = {place: x[some] for place, x in numbers.items() if not _is_point(place)}
                for name, values in self._collide(posture, own, len(some), threads).items():
                    out[name][some] = values
        return out

    def _points(self, numbers: Numbers, count: int) -> Iterator[tuple[tuple[float, ...], Rows]]:
        """Hit points, and the rows that have them."""
        own = self.file.content.problem.point
        given = {place: x for place, x in numbers.items() if _is_point(place)}
        if not given:
            yield tuple(own), np.arange(count)
            return
        point = np.repeat(np.array(own, dtype=float)[None], count, axis=0)
        for place, values in given.items():
            point[:, slice(None) if len(place) == 2 else int(place[2])] = values
        kept, back = np.unique(point, axis=0, return_inverse=True)
        for k, one in enumerate(kept):
            yield tuple(one.tolist()), np.flatnonzero(back.ravel() == k)

    @cached_property
    def _outputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(name for m in self.measures.values() for name in m.outputs))

    @cached_property
    def _together(self) -> int:
        return _WITH_HISTORIES if {*self._outputs} & {*HISTORIES} else _ROWS

    def _collide(
        self, posture: Posture, numbers: Numbers, count: int, threads: int | None
    ) -> dict[str, NDArray[Any]]:
        section, model = self.section, self.model
        joints = {name: np.full(count, angle) for name, angle in section.joints.items()}
        joints |= {str(at[2]): x for at, x in numbers.items() if at[:2] == ("at_contact", "joints_rad")}
        speed = numbers.get(("at_contact", "speed_m_s"))
        if speed is None and section.speed is not None:
            speed = np.full(count, section.speed)
        normal = np.asarray(model.normal)
        states = self.states.rows(posture, joints, speed, normal, count, velocity=section.velocity)
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.measures}
        out["reason"] = states.reason
        good = np.flatnonzero(states.reason == "")
        if not good.size:
            return out
        states = states.some(good)
        settings = {
            name: x[good] if len(x) == count else x for name, x in self._settings(numbers, count).items()
        }
        settings |= states.bend
        # a point mass has no servo, and the paper's SDC no stiffness
        known = getattr(model, "settings", settings)
        given = {name: x for name, x in settings.items() if name in known}
        if isinstance(model, SymbolicModel):
            found, reason = batch(model, self._outputs, states, given, threads)
        else:
            found, reason = one_by_one(model, self._outputs, states, given)
        blow = Blow(
            found=found,
            states=states,
            torque_limit=settings["torque_limit"],
            velocity_limit=model.robot.velocity_limit,
            polygon=posture.polygon,
        )
        for name, measure in self.measures.items():
            out[name][good] = np.where(reason == "", measure.of(blow), np.nan)
        out["reason"][good] = reason
        return out

    def _settings(self, numbers: Numbers, count: int) -> dict[str, Array]:
        """Numbers of law, target and servo by the names of `Settings`, (count, ...) or (1, ...)."""
        section, robot = self.section, self.model.robot
        out = {"kp": robot.kp[None], "kd": robot.kd[None], "torque_limit": robot.torque_limit[None]}
        scales: dict[str, Any] = {"kp": section.kp_scale, "kd": section.kd_scale}
        scales["torque_limit"] = section.torque_limit_scale
        for place, values in numbers.items():
            name = SERVO.get((str(place[0]), str(place[1])))
            if place[0] in ("target", "contact"):
                out[setting_of(place, self.file.content)] = values.astype(float)
            elif name is not None and place[0] == "robot":
                joint = slice(None) if len(place) == 2 else robot.joint_index(str(place[2]))
                out[name] = np.broadcast_to(out[name], (count, robot.n)).copy()
                out[name].T[joint] = values
            elif name is not None:
                scales[name] = values[:, None]
        return out | {name: out[name] * scale for name, scale in scales.items()}


def _is_point(place: Place) -> bool:
    return place[:2] == ("problem", "point_m")


# ---------------------------------------------------------------- models
def batch(
    model: SymbolicModel,
    outputs: tuple[str, ...],
    states: States,
    settings: Mapping[str, Array],
    threads: int | None,
) -> tuple[dict[str, Array], NDArray[np.object_]]:
    """Outputs by name, and why a row has none."""
    single: dict[str, Any] = {
        name: x[0] if x.ndim == 2 and len(x) == 1 else x for name, x in settings.items()
    }
    found = model.batch(states.q, states.v, states.torque, outputs=outputs, threads=threads, **single)
    reason = np.where(found["separated"], "", NOT_ENDED).astype(object)
    finite = np.ones(len(reason), dtype=bool)
    for name in outputs:
        if name == FREEZE_ERROR:  # may be infinite, and says so
            continue
        finite &= np.isfinite(found[name]).reshape(len(reason), -1).all(axis=1)
    reason[~finite] = NO_NUMBER
    if "step_error" in found:
        error = found["step_error"]
        for row in np.flatnonzero(np.isfinite(error) & too_large(model.stepping, error)):
            reason[row] = TOO_STIFF.format(error[row])
    return found, reason


def one_by_one(
    model: Any, outputs: tuple[str, ...], states: States, settings: Mapping[str, Array]
) -> tuple[dict[str, Array], NDArray[np.object_]]:
    """Likewise, of the full dynamics, which have no batch."""
    count = len(states.q)
    rows: list[Collision | None] = []
    reason = np.full(count, "", dtype=object)
    for i in range(count):
        own = {name: x[0 if len(x) == 1 else i] for name, x in settings.items()}
        try:
            result, _ = model.converged(
                states.q[i],
                states.v[i],
                states.torque[i],
                tolerance=_TOLERANCE,
                require_separation=False,
                **own,
            )
        except InputError as error:
            rows.append(None)
            reason[i] = str(error)
            continue
        rows.append(result)
        if not result.separated:
            reason[i] = NOT_ENDED
    return {name: _stacked([_of(row, name) for row in rows]) for name in outputs}, reason


def _of(collision: Collision | None, name: str) -> Any:
    if collision is None:
        return None
    value = getattr(collision, name)
    return list(value.values()) if name == "target_result" else value


def _stacked(values: list[Any]) -> Array:
    """Rows of equal shape: histories repeat their last instant, and what there is not is nan."""
    arrays = [None if x is None else np.asarray(x, dtype=float) for x in values]
    there = [x for x in arrays if x is not None]
    if not there:
        return np.full((len(values), 1, 1), np.nan)
    length = max((len(x) for x in there if x.ndim), default=0)
    out = []
    for x in arrays:
        if x is None:
            x = np.full(there[0].shape, np.nan)
        out.append(np.concatenate([x, np.repeat(x[-1:], length - len(x), axis=0)]) if x.ndim else x)
    return np.stack(out)
