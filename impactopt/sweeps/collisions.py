"""Many collisions of a problem: columns of parameters in, columns of numbers out, in compiled code.

What a row shares with others is made once: a robot and a model for each combination of keys that change the
structure, a posture for each hit point. All else are inputs of the compiled functions.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.collide.contact_states import ContactStates
from impactopt.collide.single_collision import (
    AtContact,
    check_at_contact,
    chosen,
    collision_model,
    full_names,
)
from impactopt.collision.checks import FREEZE_ERROR
from impactopt.collision.symbolic import SymbolicModel
from impactopt.errors import InputError, raw_array
from impactopt.files.problem_file import ProblemFile, read_problem_file
from impactopt.files.problem_file.toml import plain_value
from impactopt.sweeps.collision_batch import AlikeCollisions
from impactopt.sweeps.collision_keys import role_of, sweep_place

__all__ = ["Collisions", "collide_many"]


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
        names and numbers that make another robot or model are in few combinations. Of one value: for all.
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
            if isinstance(model, SymbolicModel):
                needed = [name for m in measures.values() for name in m.outputs if name != FREEZE_ERROR]
                model._check_outputs(tuple(needed), 1)
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
