"""Sweeps of collisions: their keys, and batches of them in one compiled call.

What a row shares with others is made once: a robot and a model for each combination of keys that change the
structure, a posture for each hit point. All else are inputs of the compiled functions.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collide.contact_states import ContactStates, Posture, States
from impactopt.collide.single_collision import (
    NOT_ENDED,
    AtContact,
    CollisionBatch,
    Measure,
    check_at_contact,
    chosen,
    collision_model,
    full_names,
    one_collision,
)
from impactopt.collision import Collision, CollisionModel
from impactopt.collision.checks import FREEZE_ERROR, too_large
from impactopt.collision.outputs import HISTORIES, OF_SERVO
from impactopt.collision.rigid import RigidImpact
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError, did_you_mean, raw_array
from impactopt.files.problem_file import ProblemFile, key_place, read_problem_file
from impactopt.files.problem_file.toml import Place, plain_value

__all__ = [
    "SERVO",
    "AlikeCollisions",
    "Collisions",
    "Role",
    "collide_many",
    "role_of",
    "setting_of",
    "sweep_place",
]

# a number of its own in each row; one that makes another posture; one that makes another model
Role = Literal["number", "point", "structure"]

SERVO = {
    ("robot", "kp_N_m_rad"): "kp",
    ("robot", "kd_N_m_s_rad"): "kd",
    ("robot", "torque_limit_N_m"): "torque_limit",
    ("at_contact", "kp_scale"): "kp",
    ("at_contact", "kd_scale"): "kd",
    ("at_contact", "torque_limit_scale"): "torque_limit",
}
_KINDS = {"target": "kind", "contact": "law"}
_STATE = (("at_contact", "speed_m_s"), ("at_contact", "joints_rad"))


def sweep_place(data: Mapping[str, Any], key: str) -> Place:
    """Place of a key path in the problem file's data, or in [at_contact]; units may be left out.

    Raises
    ------
    InputError : there is no such key, or one that no collision depends on.
    """
    if key.partition(".")[0] != "at_contact":
        place = key_place(data, key)
    else:
        place = ("at_contact", *_in_section(key))
    role_of(place)
    return place


def role_of(place: Place) -> Role:
    """Role of a key at this place in a collision; InputError if it has none."""
    table, *rest = place
    if table in _KINDS:
        return "structure" if rest == [_KINDS[str(table)]] else "number"
    if place[:2] in SERVO or place[:2] in _STATE:
        return "number"
    if place[:2] == ("problem", "point_m"):
        return "point"
    if table in ("problem", "robot", "stance", "friction", "at_contact") and rest != ["name"]:
        return "structure"
    if place == ("collision", "coefficient_of_restitution"):
        return "structure"
    key = ".".join(map(str, place))
    raise InputError(
        f"{key}: no collision depends on it; vary it in a sweep of solves, or vary a key of [target], "
        "[contact], [friction], [at_contact], [robot], [stance] or [problem]"
    )


def setting_of(place: Place, content: Any) -> str:
    """Name of a collision's setting (`Settings`) that a number of [target] or [contact] is."""
    table, key = str(place[0]), str(place[1])
    section = getattr(content, table)
    fields = {info.alias or name: name for name, info in type(section).model_fields.items()}
    return f"{table}_{fields[key]}"


def _in_section(key: str) -> tuple[str, ...]:
    _, *parts = key.split(".")
    known = {info.alias or name: name for name, info in AtContact.model_fields.items()}
    for alias, name in known.items():
        if parts and parts[0] in (alias, name):
            table = alias == "joints_rad"
            if len(parts) != 1 + table:
                raise InputError(
                    f"{key}: name one joint, as at_contact.{alias}.<joint>"
                    if table
                    else f"{key}: has no parts"
                )
            return (alias, *parts[1:])
    near = did_you_mean(parts[0] if parts else "", known)
    raise InputError(f"{key}: [at_contact] has no such key{near}; known are {', '.join(known)}")


Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Numbers = Mapping[Place, Array]  # columns of numbers, by their keys' places

_ROWS, _WITH_HISTORIES = 8192, 512  # rows at a time: histories are large
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
        states = self.states.compute(posture, joints, speed, normal, count, velocity=section.velocity)
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.measures}
        out["reason"] = states.reason
        good = np.flatnonzero(states.reason == "")
        if not good.size:
            return out
        states = states.some(good)
        settings = {
            name: x[good] if len(x) == count else x for name, x in self._settings(numbers, count).items()
        }
        settings |= states.reference_settings
        # a point mass has no servo, and the paper's SDC no stiffness
        known = getattr(model, "settings", settings)
        given = {name: x for name, x in settings.items() if name in known}
        if isinstance(model, SymbolicModel):
            found, reason = batch(model, self._outputs, states, given, threads)
        else:
            found, reason = one_by_one(model, self._outputs, states, given)
        collisions = CollisionBatch(
            found=found,
            states=states,
            torque_limit=settings["torque_limit"],
            velocity_limit=model.robot.velocity_limit,
            polygon=posture.polygon,
        )
        for name, measure in self.measures.items():
            out[name][good] = np.where(reason == "", measure.of(collisions), np.nan)
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
    """Likewise, of models that have no batch."""
    count = len(states.q)
    rows: list[Collision | None] = []
    reason = np.full(count, "", dtype=object)
    for i in range(count):
        own = {name: x[0 if len(x) == 1 else i] for name, x in settings.items()}
        try:
            result = one_collision(model, states.q[i], states.v[i], states.torque[i], **own)
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


def collide_many(
    problem: ProblemFile | str | os.PathLike[str],
    columns: Mapping[str, ArrayLike],
    *,
    outputs: Sequence[str] = ("impulse_Ns", "peak_force_N", "freeze_error_pct"),
    at_contact: Mapping[str, Any] | None = None,
    threads: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Collisions of a problem's robot with its target, one a row, in compiled code.

    Parameters
    ----------
    problem : a problem file, its path, or its name.
    columns : by key path (N) values: numbers of the problem file's [target], [contact] and servo
        (robot.kp, robot.kd, robot.torque_limit, of all joints or of one), of [at_contact], and problem.point;
        names and numbers that make another robot or model, as those of [friction] do, are in few
        combinations. Of one value: for all.
    outputs : names of columns; see docs/sweeps.md. Only what they need is computed: where a million rows are
        asked for, leave out freeze_error_pct, which takes some six times as long as the impulse.
    at_contact : the keys of [at_contact] that no column gives; see docs/sweeps.md.
    threads : cores to use; None: all.

    Returns
    -------
    By output (N) numbers, nan in rows that are impossible; and ``reason`` (N), why a row is, else "".

    Raises
    ------
    InputError : unknown keys or outputs; columns of different lengths; values that the problem file refuses.
    """
    file = problem if isinstance(problem, ProblemFile) else read_problem_file(problem)
    whole = Collisions(file, at_contact or {}, outputs, keys=tuple(columns))
    given = {key: np.atleast_1d(raw_array(key, values)) for key, values in columns.items()}
    count = max((len(x) for x in given.values()), default=1)
    for key, values in given.items():
        if not values.size:
            raise InputError(f"{key}: has no values; give at least one")
        if len(values) not in (1, count):
            raise InputError(f"{key}: has {len(values)} values and other columns {count}; give as many")
    given = {key: np.repeat(x, count, axis=0) if len(x) != count else x for key, x in given.items()}
    whole.check(given)
    return whole(given, threads=threads)


class Collisions:
    """Evaluates rows of a sweep of collisions; keeps what rows share from one call to the next.

    file, at_contact, outputs : as of `collide_many`.  keys : key paths of the columns.  folder : where a
    relative path of [at_contact] result begins.

    Raises
    ------
    InputError : as of `collide_many`; what does not depend on the columns' values.
    """

    def __init__(
        self,
        file: ProblemFile,
        at_contact: Mapping[str, Any],
        outputs: Sequence[str],
        *,
        keys: Sequence[str] = (),
        folder: Path = Path(),
    ) -> None:
        self.folder = folder
        self.file, self.at_contact, self.outputs = file, full_names(at_contact), tuple(outputs)
        self.places = {key: sweep_place(file.data, key) for key in keys}
        if len({*self.places.values()}) < len(self.places):
            raise InputError(f"two columns are of one key: {', '.join(keys)}")
        self._alike: dict[tuple[Any, ...], AlikeCollisions] = {}
        self._bodies: dict[str, ContactStates] = {}

    # ------------------------------------------------------------ checks
    def check(self, columns: Mapping[str, Any]) -> None:
        """InputError for values that the problem file, [at_contact] or a robot refuses, before work starts.

        columns : by key all values, or what bounds them: ranges of numbers are intervals.
        """
        for structure, rows in self._groups(columns):
            for key, place in self.places.items():
                if role_of(place) == "structure":
                    continue
                values = np.asarray(columns[key])[rows]
                numbers = values.dtype.kind in "fiu"  # NaN is among their least and their largest
                for value in (values.min(axis=0), values.max(axis=0)) if numbers else values:
                    self._with({**structure, key: plain_value(value)})
            alike = self._alike_of(structure)
            for place in self.places.values():
                if place[:2] == ("at_contact", "joints_rad"):
                    alike.states.check_joint(str(place[2]))
            for name in alike.section.joints:
                alike.states.check_joint(name)
            alike.posture()

    def _with(self, values: Mapping[str, Any]) -> tuple[ProblemFile, AtContact]:
        """Problem and section with other values by key."""
        section = dict(self.at_contact)
        changes = {}
        for key, value in values.items():
            place = self.places[key]
            if place[0] != "at_contact":
                changes[key] = value
            elif len(place) == 2:
                section[str(place[1])] = value
            else:
                section["joints_rad"] = {**section.get("joints_rad", {}), str(place[2]): value}
        for key, place in self.places.items():
            if place == ("at_contact", "speed_m_s") and key not in values:
                section.setdefault("speed_m_s", 1.0)  # each row has its own
        file = self.file.changed(changes)
        return file, check_at_contact(section)

    # ------------------------------------------------------------ rows
    def __call__(self, columns: Mapping[str, Any], *, threads: int | None = None) -> dict[str, NDArray[Any]]:
        """Outputs as of `collide_many`; columns (N) of all keys."""
        count = len(next(iter(columns.values()))) if columns else 1
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.outputs}
        out["reason"] = np.full(count, "", dtype=object)
        numbers = {p: np.asarray(columns[key]) for key, p in self.places.items() if role_of(p) != "structure"}
        for structure, rows in self._groups(columns):
            own = {place: x[rows] for place, x in numbers.items()}
            for name, values in self._alike_of(structure)(own, len(rows), threads).items():
                out[name][rows] = values
        return out

    def _groups(self, columns: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], NDArray[np.intp]]]:
        """Values of the keys that make the structure, and the rows that have them."""
        count = len(next(iter(columns.values()))) if columns else 1
        keys = [key for key, place in self.places.items() if role_of(place) == "structure"]
        if not keys:
            yield {}, np.arange(count)
            return
        groups: dict[str, tuple[dict[str, Any], list[int]]] = {}
        lists = [plain_value(columns[key]) for key in keys]
        for row, values in enumerate(zip(*lists, strict=True)):
            groups.setdefault(repr(values), (dict(zip(keys, values, strict=True)), []))[1].append(row)
        for structure, rows in groups.values():
            yield structure, np.array(rows, dtype=np.intp)

    def _alike_of(self, structure: Mapping[str, Any]) -> AlikeCollisions:
        key = tuple(repr(structure[name]) for name in sorted(structure))
        if key not in self._alike:
            file, section = self._with(structure)
            states = self._body(file)
            model = collision_model(file.content, states.robot, states.stance, section)
            measures = chosen(self.outputs, model.target)
            needed = [name for m in measures.values() for name in m.outputs if name != FREEZE_ERROR]
            if isinstance(model, SymbolicModel):
                model._check_outputs(tuple(needed), 1)
            elif isinstance(model, RigidImpact) and (unknown := [x for x in needed if x in OF_SERVO]):
                raise InputError(f"output {unknown[0]!r}: a rigid impact knows nothing of it; leave it out")
            self._alike[key] = AlikeCollisions(
                file=file, section=section, model=model, states=states, measures=measures
            )
        return self._alike[key]

    def _body(self, file: ProblemFile) -> ContactStates:
        """Contact states of a robot on its stance, which models share."""
        problem, content = file.data["problem"], file.content
        names = [problem.get(name) for name in ("robot", "striker", "start")]
        key = repr([*names, file.data.get("robot"), file.data.get("stance")])
        if key not in self._bodies:
            robot = content.make_robot(file.path.parent)
            self._bodies[key] = ContactStates(
                robot=robot,
                striker=content.problem.striker,
                stance=content.make_stance(robot),
                start=content.make_start(robot),
                folder=self.folder,
            )
        return self._bodies[key]
