"""Many collisions of a problem: which keys they may vary in, and their evaluation in compiled batches.

A robot and a model are made once for each combination of structural keys, and a posture once for each hit
point. All other values are inputs of the compiled functions.
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

from impactopt.arrays import Array, Index
from impactopt.collide.contact_states import ContactStates, Posture, States
from impactopt.collide.single_collision import (
    NOT_ENDED,
    AtContact,
    CollisionResults,
    Measure,
    check_at_contact,
    chosen,
    collision_model,
    finer,
    full_names,
    servo_settings,
    weightless,
)
from impactopt.collision import Collision, CollisionModel
from impactopt.collision.checks import FREEZE_ERROR, too_large
from impactopt.collision.outputs import HISTORIES, OF_SERVO
from impactopt.collision.rigid import RigidImpact
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError, check_kind, did_you_mean, raw_array
from impactopt.files.problem_file import ProblemFile, key_place, read_problem_file
from impactopt.files.toml import Place, plain_value

# Role of a key: "number", an input of the compiled functions; "point", which changes the posture;
# "structure", which changes the robot or the model.
Role = Literal["number", "point", "structure"]

# Settings of the servo, by the places of factors on them. The robot's own gains are structure: one changes
# the default of another.
SERVO_SCALES = {
    ("at_contact", "kp_scale"): "kp",
    ("at_contact", "kd_scale"): "kd",
    ("at_contact", "torque_limit_scale"): "torque_limit",
}
_TYPE_KEYS = {"target": "kind", "contact": "law"}  # keys that select the class of the target or law
_STATE = (("at_contact", "speed_m_s"), ("at_contact", "joints_rad"))


def sweep_place(data: Mapping[str, Any], key: str) -> Place:
    """Place of a key path in the problem file's data, or in [at_contact]; units may be left out.

    Raises
    ------
    InputError : there is no such key, or no collision depends on it.
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
    if table in _TYPE_KEYS and rest[:1] != ["body"]:  # a target's body is for clearance
        return "structure" if rest == [_TYPE_KEYS[str(table)]] else "number"
    if place[:2] in SERVO_SCALES or place[:2] in _STATE:
        return "number"
    if place[:2] == ("problem", "point_m"):
        return "point"
    if table in ("problem", "robot", "stance", "friction", "at_contact") and rest != ["name"]:
        return "structure"
    if place == ("collision", "coefficient_of_restitution") or _is_stance(place):
        return "structure"
    key = ".".join(map(str, place))
    raise InputError(
        f"{key}: no collision depends on it; vary it in a sweep of solves, or vary a key of [target], "
        "[contact], [friction], [at_contact], [robot], [stance] or [problem], or soles of [[stances]]"
    )


def _is_stance(place: Place) -> bool:
    """True for soles and steps of a stance phase, not for its duration and spline."""
    return place[0] == "stances" and place[2:3] in (("soles",), ("steps_m",))


def setting_of(place: Place, content: Any) -> str:
    """Name in `Settings` of a number of [target] or [contact]."""
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


Numbers = Mapping[Place, Array]  # values (count, ...) of the keys with the role "number" or "point"

# collisions in one call of a compiled batch, without and with histories, which are large
_MAX_BATCH, _MAX_BATCH_HISTORIES = 8192, 512
# reasons that a collision has no result
NO_NUMBER = (
    "the collision has no finite numbers: its steps are unstable here, or the constraints that fix the robot "
    "are linearly dependent"
)
TOO_STIFF = (
    "the contact is too stiff for the steps of its law: {:.1g} of the impulse would be left out; take the "
    "model 'full'"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class CollisionBatch:
    """Collisions with one robot and one model, which differ in numbers and hit points only.

    file, section : problem and [at_contact], with the values of the structural keys.
    model : of the collision.  states : makes the states at contact.  measures : outputs by name.
    """

    file: ProblemFile
    section: AtContact
    model: CollisionModel
    states: ContactStates
    measures: Mapping[str, Measure]

    def posture(self, point: tuple[float, ...] | None = None) -> Posture | str:
        """Posture at contact for a hit point (3,) [m], by default the problem's; or the reason that there is
        none.

        Raises
        ------
        InputError : as of `ContactStates.posture`.
        """
        at = tuple(self.file.content.problem.point) if point is None else point
        return self.states.posture(self.section.posture, self.section.result, at)

    def __call__(self, numbers: Numbers, count: int, threads: int | None) -> dict[str, NDArray[Any]]:
        """Values (count,) of each measure, nan where there is no result, and the ``reason`` (count,) for
        it.
        """
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.measures}
        out["reason"] = np.full(count, "", dtype=object)
        for point, indices in self._by_point(numbers, count):
            posture = self.posture(point)
            if isinstance(posture, str):
                out["reason"][indices] = posture
                continue
            for begin in range(0, len(indices), self._max_batch):
                some = indices[begin : begin + self._max_batch]
                own = {place: x[some] for place, x in numbers.items() if not _is_point(place)}
                for name, values in self._collide(posture, own, len(some), threads).items():
                    out[name][some] = values
        return out

    def _by_point(self, numbers: Numbers, count: int) -> Iterator[tuple[tuple[float, ...], Index]]:
        """Hit points, each with the indices of its collisions."""
        own = self.file.content.problem.point
        given = {place: x for place, x in numbers.items() if _is_point(place)}
        if not given:
            yield tuple(own), np.arange(count)
            return
        point = np.repeat(np.array(own, dtype=float)[None], count, axis=0)
        for place, values in given.items():
            # the key is problem.point, or one coordinate of it
            point[:, slice(None) if len(place) == 2 else int(place[2])] = values
        distinct, inverse = np.unique(point, axis=0, return_inverse=True)
        for k, one in enumerate(distinct):
            yield tuple(one.tolist()), np.flatnonzero(inverse.ravel() == k)

    @cached_property
    def _outputs(self) -> tuple[str, ...]:
        needed = [name for m in self.measures.values() for name in m.outputs]
        # which tells if histories need shorter steps
        return tuple(dict.fromkeys([*needed, "duration"] if self._has_histories else needed))

    @cached_property
    def _has_histories(self) -> bool:
        return any(name in HISTORIES for m in self.measures.values() for name in m.outputs)

    @cached_property
    def _max_batch(self) -> int:
        return _MAX_BATCH_HISTORIES if self._has_histories else _MAX_BATCH

    def _collide(
        self, posture: Posture, numbers: Numbers, count: int, threads: int | None
    ) -> dict[str, NDArray[Any]]:
        """Values as of `__call__`, for collisions in one posture and in one call of the model."""
        section, model = self.section, self.model
        joints = {name: np.full(count, angle) for name, angle in section.joints.items()}
        joints |= {str(at[2]): x for at, x in numbers.items() if at[:2] == ("at_contact", "joints_rad")}
        speed = numbers.get(("at_contact", "speed_m_s"))
        if speed is None and section.speed is not None:
            speed = np.full(count, section.speed)
        normal = np.asarray(model.normal)
        states = self.states.compute(posture, joints, speed, normal, count, velocity=section.velocity)
        settings, target = self._settings(numbers), model.target
        own = {name: settings.get(f"target_{name}", value) for name, value in target.parameters.items()}
        states = states.approaching(target.speed_before(own))
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.measures}
        out["reason"] = states.reason
        good = np.flatnonzero(states.reason == "")
        if not good.size:
            return out
        states = states.some(good)
        settings = {name: x[good] if len(x) == count else x for name, x in settings.items()}
        settings |= states.reference_settings
        values, found = self._measured(model, states, settings, posture, threads)
        for resolving, some in finer(model, found["duration"]) if self._has_histories else ():
            theirs = {name: x[some] if len(x) == len(good) else x for name, x in settings.items()}
            better, _ = self._measured(resolving, states.some(some), theirs, posture, threads)
            for name, x in better.items():
                values[name][some] = x
        for name, x in values.items():
            out[name][good] = x
        return out

    def _measured(
        self,
        model: CollisionModel,
        states: States,
        settings: Mapping[str, Array],
        posture: Posture,
        threads: int | None,
    ) -> tuple[dict[str, NDArray[Any]], Mapping[str, Array]]:
        """Values (count,) as of `__call__` for states at contact, and the model's outputs."""
        # a point mass has no servo, and the paper's SDC no stiffness
        known = getattr(model, "settings", settings)
        given = {name: x for name, x in settings.items() if name in known}
        if isinstance(model, SymbolicModel):
            found, reason = batch(model, self._outputs, states, given, threads)
        else:
            found, reason = one_by_one(model, self._outputs, states, given)
        collisions = CollisionResults(
            found=found,
            states=states,
            robot=model.robot,
            torque_limit=settings["torque_limit"],
            polygon=posture.polygon,
        )
        values: dict[str, NDArray[Any]] = {
            name: np.where(reason == "", measure.of(collisions), np.nan)
            for name, measure in self.measures.items()
        }
        return {**values, "reason": reason}, found

    def _settings(self, numbers: Numbers) -> dict[str, Array]:
        """Parameters of law, target and servo by their names in `Settings`, (count, ...) or (1, ...)."""
        out, scales = dict[str, Array](), dict[str, Array]()
        for place, values in numbers.items():
            name = SERVO_SCALES.get((str(place[0]), str(place[1])))
            if place[0] in ("target", "contact"):
                out[setting_of(place, self.file.content)] = values.astype(float)
            elif name is not None:
                scales[name] = values[:, None]
        servo = servo_settings(self.model.robot, self.section, **scales)
        return out | {name: np.atleast_2d(x) for name, x in servo.items()}


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
    """Outputs (count, ...) of a compiled model by name, and for each collision the reason that it has
    none.
    """
    # the batch takes a setting that all collisions share without the axis of collisions
    single: dict[str, Any] = {
        name: x[0] if x.ndim == 2 and len(x) == 1 else x for name, x in settings.items()
    }
    found = model.batch(states.q, states.v, states.torque, outputs=outputs, threads=threads, **single)
    reason = np.where(found["separated"], "", NOT_ENDED).astype(object)
    finite = np.ones(len(reason), dtype=bool)
    for name in outputs:
        if name == FREEZE_ERROR:  # infinity is a result: frozen more often, the contact does not end
            continue
        finite &= np.isfinite(found[name]).reshape(len(reason), -1).all(axis=1)
    reason[~finite] = NO_NUMBER
    if "step_error" in found:
        error = found["step_error"]
        for k in np.flatnonzero(np.isfinite(error) & too_large(model.stepping, error)):
            reason[k] = TOO_STIFF.format(error[k])
    return found, reason


def one_by_one(
    model: Any, outputs: tuple[str, ...], states: States, settings: Mapping[str, Array]
) -> tuple[dict[str, Array], NDArray[np.object_]]:
    """Outputs and reasons as of `batch`, for a model without compiled batches."""
    count = len(states.q)
    collisions: list[Collision | None] = []
    reason = np.full(count, "", dtype=object)
    for i in range(count):
        own = {name: x[0 if len(x) == 1 else i] for name, x in settings.items()}
        try:
            result = model.collide(
                states.q[i], states.v[i], states.torque[i], require_separation=False, **own
            )
        except InputError as error:
            collisions.append(None)
            reason[i] = str(error)
            continue
        collisions.append(result)
        if not result.separated:
            reason[i] = NOT_ENDED
    return {name: _stacked([_output(one, name) for one in collisions]) for name in outputs}, reason


def _output(collision: Collision | None, name: str) -> Any:
    if collision is None:
        return None
    value = getattr(collision, name)
    return list(value.values()) if name == "target_result" else value


def _stacked(values: list[Any]) -> Array:
    """Values in one array; a missing one is nan, and shorter histories repeat their last instant."""
    arrays = [None if x is None else np.asarray(x, dtype=float) for x in values]
    known = [x for x in arrays if x is not None]
    if not known:
        return np.full((len(values), 1, 1), np.nan)
    length = max((len(x) for x in known if x.ndim), default=0)
    out = []
    for x in arrays:
        if x is None:
            x = np.full(known[0].shape, np.nan)
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
    """Evaluate N collisions of a problem's robot with its target, in compiled code.

    Parameters
    ----------
    problem : a problem file, its path, or its name.
    columns : values (N,), or a single one for all collisions, by key path: numbers of the problem file's
        [target], [contact] and [at_contact] (kd_scale is a factor on all dampings), and problem.point. Each
        combination of other values, such as those of [friction] or robot.kd, makes a robot or model: these
        should be few.
    outputs : names of columns; see docs/sweeps.md. Only what they need is computed. For a million collisions
        leave out freeze_error_pct, which takes some six times as long as the impulse.
    at_contact : the keys of [at_contact] that no column gives; see docs/sweeps.md.
    threads : cores to use; None: all.

    Returns
    -------
    Numbers (N,) by output, nan for collisions that are impossible; and ``reason`` (N,), why a collision is
    impossible, else "".

    Raises
    ------
    InputError : unknown keys or outputs; columns of different lengths; values that the problem file refuses.
    """
    columns = dict(columns) if hasattr(columns, "keys") else columns  # a pandas table is no Mapping
    check_kind("columns", columns, Mapping)
    state = {} if at_contact is None else at_contact
    check_kind("at_contact", state, Mapping)
    file = problem if isinstance(problem, ProblemFile) else read_problem_file(problem)
    collisions = Collisions(file, state, outputs, keys=tuple(columns))
    given = {key: np.atleast_1d(raw_array(key, values)) for key, values in columns.items()}
    count = max((len(x) for x in given.values()), default=1)
    for key, values in given.items():
        if not values.size:
            raise InputError(f"{key}: has no values; give at least one")
        if len(values) not in (1, count):
            raise InputError(f"{key}: has {len(values)} values and other columns {count}; give as many")
    given = {key: np.repeat(x, count, axis=0) if len(x) != count else x for key, x in given.items()}
    collisions.check(given)
    return collisions(given, threads=threads)


class Collisions:
    """Evaluates collisions with varied keys; robots, models and postures are kept from one call to the next.

    file, at_contact, outputs : as of `collide_many`.  keys : key paths of the columns.  folder : where a
    relative path of [at_contact] result begins.

    Raises
    ------
    InputError : as of `collide_many`, for mistakes that do not depend on the columns' values.
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
        self.file, self.at_contact = file, full_names(at_contact)
        self.outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
        self.places = {key: sweep_place(file.data, key) for key in keys}
        if len({*self.places.values()}) < len(self.places):
            raise InputError(f"two columns are of one key: {', '.join(keys)}")
        self._batches: dict[tuple[Any, ...], CollisionBatch] = {}  # by the values of the structural keys
        self._states: dict[str, ContactStates] = {}  # by robot and stance

    # ------------------------------------------------------------ checks
    def check(self, columns: Mapping[str, Any]) -> None:
        """Checks values before work starts.

        columns : all values by key, or their bounds.

        Raises
        ------
        InputError : values that the problem file, [at_contact] or a robot refuses.
        """
        for structure, indices in self._groups(columns):
            for key, place in self.places.items():
                if role_of(place) == "structure":
                    continue
                values = raw_array(key, columns[key])[indices]
                # allowed numbers are intervals, so the extremes are enough; a NaN is both of them
                numbers = values.dtype.kind in "fiu"
                for value in (values.min(axis=0), values.max(axis=0)) if numbers else values:
                    self._with({**structure, key: plain_value(value)})
            one = self._batch(structure)
            for place in self.places.values():
                if place[:2] == ("at_contact", "joints_rad"):
                    one.states.check_joint(str(place[2]))
            for name in one.section.joints:
                one.states.check_joint(name)
            one.posture()

    def _with(self, values: Mapping[str, Any]) -> tuple[ProblemFile, AtContact]:
        """Problem and [at_contact] with other values by key."""
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
                section.setdefault("speed_m_s", 1.0)  # any value: each collision has its own
        file = self.file.changed(changes)
        return file, check_at_contact(section)

    # ------------------------------------------------------------ evaluation
    def __call__(self, columns: Mapping[str, Any], *, threads: int | None = None) -> dict[str, NDArray[Any]]:
        """Outputs as of `collide_many`; columns (N,) of all keys."""
        count = len(next(iter(columns.values()))) if columns else 1
        out: dict[str, NDArray[Any]] = {name: np.full(count, np.nan) for name in self.outputs}
        out["reason"] = np.full(count, "", dtype=object)
        numbers = {p: np.asarray(columns[key]) for key, p in self.places.items() if role_of(p) != "structure"}
        for structure, indices in self._groups(columns):
            own = {place: x[indices] for place, x in numbers.items()}
            for name, values in self._batch(structure)(own, len(indices), threads).items():
                out[name][indices] = values
        return out

    def _groups(self, columns: Mapping[str, Any]) -> Iterator[tuple[dict[str, Any], Index]]:
        """Combinations of values of the structural keys, each with the indices of its collisions."""
        count = len(next(iter(columns.values()))) if columns else 1
        keys = [key for key, place in self.places.items() if role_of(place) == "structure"]
        if not keys:
            yield {}, np.arange(count)
            return
        groups: dict[str, tuple[dict[str, Any], list[int]]] = {}
        lists = [plain_value(columns[key]) for key in keys]
        for k, values in enumerate(zip(*lists, strict=True)):
            groups.setdefault(repr(values), (dict(zip(keys, values, strict=True)), []))[1].append(k)
        for structure, indices in groups.values():
            yield structure, np.array(indices, dtype=np.intp)

    def _batch(self, structure: Mapping[str, Any]) -> CollisionBatch:
        key = tuple(repr(structure[name]) for name in sorted(structure))
        if key not in self._batches:
            file, section = self._with(structure)
            states = self._contact_states(file)
            model = collision_model(file.content, states.robot, states.stance, section)
            measures = chosen(self.outputs, model.target)
            needed = [name for m in measures.values() for name in m.outputs if name != FREEZE_ERROR]
            if isinstance(model, SymbolicModel):
                model._check_outputs(tuple(needed), 1)
            elif isinstance(model, RigidImpact) and (unknown := [x for x in needed if x in OF_SERVO]):
                raise InputError(f"output {unknown[0]!r}: a rigid impact knows nothing of it; leave it out")
            if "sole_force_N" in measures and weightless(model):
                raise InputError(
                    f"output 'sole_force_N': the model {section.model!r} has no gravity, so that forces on "
                    "single soles lack the weight; leave it out, or take 'sdc' or 'full'"
                )
            self._batches[key] = CollisionBatch(
                file=file, section=section, model=model, states=states, measures=measures
            )
        return self._batches[key]

    def _contact_states(self, file: ProblemFile) -> ContactStates:
        """Contact states of a robot on its stance, which several models share."""
        problem, content = file.data["problem"], file.content
        names = [problem.get(name) for name in ("robot", "striker", "start")]
        sections = [file.data.get(name) for name in ("robot", "stance", "stances")]
        key = repr([*names, *sections])
        if key not in self._states:
            robot = content.make_robot(file.path.parent)
            stance, start = content.stance_at_impact(robot)
            self._states[key] = ContactStates(
                robot=robot,
                striker=content.problem.striker,
                stance=stance,
                start=start,
                folder=self.folder,
            )
        return self._states[key]
