"""A saved result, checked: its program evaluated anew, and its numbers against that and Pinocchio.

The package's own program says what constraints, objective and KKT residual are, so that every term is known.
The recorded motion is checked by Pinocchio alone: does it follow from its velocities, stand where it is held,
hit the point, and need the torques that it has? (A program written down a second time is in `tests/oracle/`.)
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.codegen.files import read_plain
from impactopt.errors import InputError
from impactopt.files.output import LARGEST, NUMBERS, SUMMARY, Record, load_record, record_of
from impactopt.files.replay import problem_of, program_of_record, solution_of_record
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.loads import weight_of
from impactopt.solvers.program import bound_violations, complementarity, row_violations, scaled_residual
from impactopt.transcription.contact_refinement import contact_error
from impactopt.transcription.transcription import Transcription, statement_of

__all__ = ["KKT", "VIOLATION", "Verdict", "motion_of_record", "verify", "verify_record"]

Array = NDArray[np.float64]
VIOLATION = 1e-5  # of constraints, which are of order one, and of what a record says
KKT = 1e-4  # as of solvers that call a point acceptable
OBJECTIVE = 1e-9  # of its size, and of one
TOLD = 3  # violations at most, in a reason
# what of a record follows from its variables, by the names of its arrays
FOLLOWS = ("plan_", "swing_", "follow_", "collision_", "reference_", "missed_")
SUMMED = ("impulse_Ns", "contact_ms", "hand_speed_m_s", "duration_s", "target", "objectives", "scenarios")


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Findings of a verification.

    ok : nothing is violated, the KKT conditions hold, and all that the problem states was computed.
    max_violation : of all constraints and of what the record says.  kkt : residual; None with a `reason`.
    objective : what is minimized [N s], computed here; None where it is not known.
    rows : by name, worst violation and where.
    reason : why it is not ok, or what could not be computed; "".
    """

    ok: bool
    max_violation: float
    kkt: float | None
    objective: float | None
    rows: dict[str, tuple[float, str]]
    reason: str = ""

    def describe(self) -> dict[str, Any]:
        """Content of `impactopt verify --json`."""
        return {
            "ok": self.ok,
            "max_violation": self.max_violation,
            "kkt": self.kkt,
            "objective": self.objective,
            "rows": {name: {"violation": by, "where": where} for name, (by, where) in self.rows.items()},
            "reason": self.reason,
        }


def verify(result: str | os.PathLike[str], *, problem_file: str | os.PathLike[str] | None = None) -> Verdict:
    """Constraints, objective and KKT residual of a result, computed anew from its files alone.

    result : a directory that `impactopt solve` wrote, or its `solution.npz`.
    problem_file : instead of the record's own text, such as when its URDF has moved.

    Raises
    ------
    InputError : there is no record, or it does not say what its program was.
    """
    record, path = load_record(result), Path(result)
    problem = problem_of(record, path, problem_file, None)
    beside = (path.parent if path.name == NUMBERS and not path.is_dir() else path) / SUMMARY
    other = beside.exists() and _read(beside) != record.summary
    return verify_record(record, problem, other_summary=other)


def verify_record(record: Record, problem: ImpactProblem, *, other_summary: bool = False) -> Verdict:
    """Verdict on a record of a problem; other_summary : the one beside it is not its own.

    Raises
    ------
    InputError : it does not say what its program was, or says so in a way that cannot be read.
    """
    if "program_statement" not in record.arrays:
        raise InputError(
            "this result does not say what its program's variables and constraints are: it is a strike, or "
            "of an impactopt before `verify`; solve again with `impactopt solve`"
        )
    found = _Found()
    if other_summary:
        found.note("summary", np.inf, SUMMARY)
        found.reasons.append(f"{SUMMARY} is not the summary in {NUMBERS}")
    try:
        made = program_of_record(record, problem)
        same = made is not None and _same_program(made, record)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        mend = "solve again with `impactopt solve`"
        raise InputError(f"what this result says of its program is damaged ({error!r}); {mend}") from error
    if made is None or not same:
        found.reasons.append("its program is not the one that its problem has today: solve again")
        return found.verdict(None, None)
    kkt, objective = found.program(made, record.arrays)
    for name, amount, where in _in_record(made, record):
        found.note(name, amount, where)
    return found.verdict(kkt, objective)


def _read(path: Path) -> Any:
    try:
        return json.loads(read_plain(path, LARGEST))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); solve again with `impactopt solve`") from error


def _same_program(t: Transcription, record: Record) -> bool:
    """Equality of the names and numbers of variables and constraints with those that the record says."""
    told, today = json.loads(str(record.arrays["program_statement"])), json.loads(statement_of(t))
    n, m = t.program.n, t.program.m
    sizes = {"solver_x": n, "solver_bound_multipliers": n, "solver_multipliers": m}
    return all(told[key] == today[key] for key in ("groups", "rows", "components")) and all(
        len(np.atleast_1d(record.arrays[name])) == size for name, size in sizes.items()
    )


class _Found:
    """Worst violations by name, and what is wrong in words."""

    def __init__(self) -> None:
        self.rows: dict[str, tuple[float, str]] = {}
        self.reasons: list[str] = []

    def note(self, name: str, amount: float, where: str) -> None:
        """Keep the worst violation of each name; what is no number is as bad as can be."""
        amount = float(amount) if np.isfinite(amount) else np.inf
        if name not in self.rows or amount > self.rows[name][0]:
            self.rows[name] = max(amount, 0.0), where

    def program(self, t: Transcription, arrays: Mapping[str, NDArray[Any]]) -> tuple[float, float]:
        """KKT residual and objective at the record's variables; violations are noted."""
        program, x = t.program, np.asarray(arrays["solver_x"], dtype=float)
        g = program.constraints(x)
        for row, off in zip(t.rows.origins, row_violations(program, g), strict=True):
            self.note(row.term, off, ", ".join(part for part in (row.place.name, row.component) if part))
        off = bound_violations(program, x)
        worst = int(np.argmax(off))
        self.note("bounds of variables", float(off[worst]), program.variable_name(worst))
        objective, told = float(program.objective(x)), float(arrays["solver_objective"])
        gap = abs(objective - told) / max(1.0, abs(objective))
        self.note("objective", 0.0 if gap < OBJECTIVE else gap, "solver_objective")
        y, z = (
            np.asarray(arrays[f"solver_{name}"], dtype=float) for name in ("multipliers", "bound_multipliers")
        )
        # a variable that is given has no slope to be zero
        free = program.x_lower < program.x_upper
        left = np.where(free, program.gradient(x) + program.jacobian(x).T @ y + z, 0.0)
        kkt = max(scaled_residual(left, y, z), complementarity(program, x, g, y, z))
        if not kkt <= KKT:
            name = program.variable_name(int(np.argmax(np.abs(left))))
            self.reasons.append(f"the KKT residual is {kkt:.2g}, more than {KKT:g}; worst: {name}")
        return kkt, objective

    def verdict(self, kkt: float | None, objective: float | None) -> Verdict:
        by_size = sorted(self.rows.items(), key=lambda item: -item[1][0])
        violated = [
            f"{name}, {where}: off by {by:.3g}, more than {VIOLATION:g}"
            for name, (by, where) in by_size[:TOLD]
            if by > VIOLATION
        ]
        return Verdict(
            ok=not violated and not self.reasons,
            max_violation=max((by for by, _ in self.rows.values()), default=float("inf")),
            kkt=kkt,
            objective=objective,
            rows=self.rows,
            reason="; ".join([*violated, *self.reasons]),
        )


# ---------------------------------------------------------------- what else is in the record
Off = tuple[str, float, str]  # name, by how much it is off, where


def _in_record(t: Transcription, record: Record) -> Iterator[Off]:
    """Arrays and summary against those that follow from the variables; the motion by itself."""
    solution = solution_of_record(record, t)
    finer = contact_error(t, solution.result.x)
    again = record_of(dataclasses.replace(solution, contact_error=finer))
    for name in sorted(again.arrays.keys() & record.arrays.keys()):
        if name.startswith(FOLLOWS):
            yield "record", _gap(record.arrays[name], again.arrays[name]), name
    for key in SUMMED:
        if key in record.summary:
            yield from _numbers_of(record.summary[key], again.summary.get(key), key)
    clearance = again.summary.get("clearance_mm")
    if t.problem.keeps_apart and clearance is not None:
        yield "distance of bodies", -1e-3 * clearance, "the motion"
    for prefix in ("reference", "missed"):
        if f"{prefix}_time" in record.arrays:
            yield from motion_of_record(t.problem, record.arrays, prefix)


def _gap(found: Any, wanted: Any) -> float:
    """Largest difference, over the size of what is wanted where that is above one; inf for other shapes."""
    if np.asarray(wanted).dtype.kind not in "fiub":
        return 0.0 if np.array_equal(found, wanted) else np.inf
    one, two = np.asarray(found, dtype=float), np.asarray(wanted, dtype=float)
    if one.shape != two.shape:
        return np.inf
    unknown = np.isnan(two)
    if (np.isnan(one) != unknown).any():
        return np.inf
    size = max(1.0, float(np.abs(two[~unknown]).max(initial=0.0)))
    return float(np.abs(one - two)[~unknown].max(initial=0.0)) / size


def _numbers_of(found: Any, wanted: Any, where: str) -> Iterator[Off]:
    """Every number of a summary's entry; of a text whether it is the same."""
    if isinstance(wanted, Mapping) and isinstance(found, Mapping):
        for key in wanted:
            yield from _numbers_of(found.get(key), wanted[key], f"{where}.{key}")
    elif isinstance(wanted, list) and isinstance(found, list) and len(found) == len(wanted):
        for k, (one, two) in enumerate(zip(found, wanted, strict=True)):
            yield from _numbers_of(one, two, f"{where}.{k}")
    elif isinstance(wanted, float | int) and isinstance(found, float | int):
        yield "summary", abs(found - wanted) / max(abs(wanted), 1e-3), where
    else:
        yield "summary", 0.0 if found == wanted else np.inf, where


def motion_of_record(
    problem: ImpactProblem, arrays: Mapping[str, NDArray[Any]], prefix: str = "reference"
) -> Iterator[Off]:
    """Violations of a recorded motion, by Pinocchio: rates, held soles, hit point, forces, and limits.

    prefix : of the arrays, "reference" or "missed". Each is a name, by how much it is off, and where.
    """
    names = ("time", "phase", "q", "v", "a", "torque")
    time, phase, q, v, a, torque = (np.asarray(arrays[f"{prefix}_{name}"]) for name in names)
    wrench = np.asarray(arrays.get(f"{prefix}_sole_wrench", np.zeros((0, 0))))
    robot, held = problem.robot, [c.legs for c in problem.stance_coordinates]
    model, data = robot.model, robot.model.createData()
    # where the wrench of each frame begins, and which stance it is
    frames = [sole.frame for sole in problem.soles] if problem.stances else problem.coordinates.frames
    columns = {frame: 6 * k for k, frame in enumerate(frames)}
    stance = np.asarray(arrays.get(f"{prefix}_stance", ()), dtype=int)
    stance = stance if stance.size else np.zeros(len(time), dtype=int)
    steps = np.flatnonzero((np.diff(time) > 0) & (np.diff(phase) == 0))
    for k in map(int, steps):
        # from one instant to the next, by the trapezoidal rule with its first correction
        h = time[k + 1] - time[k]
        moved = h * (v[k] + v[k + 1]) / 2 - h**2 * (a[k + 1] - a[k]) / 12
        off = float(np.abs(pin.difference(model, q[k], q[k + 1]) - moved).max())
        # what is beyond the rule: a tenth of what the correction is
        beyond = 0.1 * h**2 * float(np.abs(a[k + 1] - a[k]).max()) + h**3 * float(np.abs(v[k]).max() ** 2)
        yield f"{prefix}: rates", off - beyond, f"{time[k]:.4g} s"
    limit, still = robot.torque_limit, np.zeros(robot.nv - robot.n)
    scale = np.concatenate([np.full(len(still), max(1.0, weight_of(robot))), limit])
    for i, instant in enumerate(time):
        where = f"{instant:.4g} s"
        tau = robot.inverse_dynamics(data, q[i], v[i], a[i])
        pin.computeJointJacobians(model, data, q[i])
        pin.updateFramePlacements(model, data)
        for leg in held[stance[i]]:
            frame, at = model.getFrameId(leg.frame), columns[leg.frame]
            off = np.abs(pin.log6(leg.placement.actInv(data.oMf[frame])).vector).max()
            yield f"{prefix}: held soles", float(off), where
            if wrench.size:
                jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
                tau -= jacobian.T @ wrench[i, at : at + 6]
        if phase[i] != 1 and (wrench.size or not columns):  # in contact the hand bears force, too
            needed = np.concatenate([still, torque[i]])
            yield f"{prefix}: equation of motion", float(np.abs((tau - needed) / scale).max()), where
        yield f"{prefix}: torque limit", float(np.abs(torque[i] / limit).max() - 1), where
        if phase[i] != 1:  # in contact the reference coasts
            name, excess = robot.ranges.excess(robot.joint_positions(q[i : i + 1]))
            yield f"{prefix}: position limit", excess, f"{name}, {where}"
        fast = np.abs(v[i][-robot.n :]) / robot.velocity_limit
        yield f"{prefix}: velocity limit", float(fast.max() - 1), where
    if prefix == "reference" and (phase == 0).any():
        end = int(np.flatnonzero(phase == 0)[-1])
        for striker, point in problem.contacts:
            pin.framesForwardKinematics(model, data, q[end])
            at = data.oMf[model.getFrameId(f"striker:{striker}")].translation
            yield "reference: hit point", float(np.abs(at - point).max()), striker
