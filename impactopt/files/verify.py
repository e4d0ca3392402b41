"""Verification of a saved result: its nonlinear program (NLP) is evaluated, its motion checked by Pinocchio.

Constraints, objective and KKT residual are those of the package's own program, so that every term is covered.
Pinocchio alone checks the recorded motion: its velocities, fixed soles, striking point and torques. (An
independent statement of the program is in `tests/oracle/`.)
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.bodies.clearance import SURVEYED
from impactopt.errors import InputError
from impactopt.files.output import record_of
from impactopt.files.record import NUMBERS, SUMMARY, Record, load_record, read_json
from impactopt.files.replay import problem_of, program_of_record, solution_of_record
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import HitRegion
from impactopt.robots.loads import weight_of
from impactopt.solvers.program import (
    bound_violations,
    complementarity,
    constraint_violations,
    scaled_residual,
)
from impactopt.transcription.transcription import Transcription, statement_of

VIOLATION = 1e-5  # of constraints, which are of order one, and of recorded numbers
KKT = 1e-4  # as of solvers that call a point acceptable
OBJECTIVE_TOLERANCE = 1e-9  # relative to the objective's size, at least to one
MAX_REPORTED = 3  # violations in a reason
# prefixes of the arrays, and keys of the summary, that can be computed from the program's variables
RECOMPUTED = ("plan_", "swing_", "follow_", "collision_", "reference_", "missed_")
KEYS = ("impulse_Ns", "contact_ms", "hand_speed_m_s", "duration_s", "target", "objectives", "scenarios")
CONTACT = 1  # phase


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Findings of a verification.

    ok : nothing is violated, the KKT conditions hold, and everything could be computed.
    max_violation : largest one of constraints and recorded numbers.  kkt : residual; None with a `reason`.
    objective : objective function [N s], computed here; None if it could not be computed.
    rows : worst violation and its place, by the name of what was checked.
    reason : why it is not ok, or what could not be computed; "" if it is ok.
    """

    ok: bool
    max_violation: float
    kkt: float | None
    objective: float | None
    rows: dict[str, tuple[float, str]]
    reason: str = ""

    def describe(self) -> dict[str, Any]:
        """Content of `impactopt verify --json`."""
        rows = {name: {"violation": by, "where": where} for name, (by, where) in self.rows.items()}
        return {**vars(self), "rows": rows}


def verify(result: str | os.PathLike[str], *, problem_file: str | os.PathLike[str] | None = None) -> Verdict:
    """Constraints, objective and KKT residual of a result, computed anew from its files alone.

    result : a directory that `impactopt solve` wrote, or its `solution.npz`.
    problem_file : used instead of the record's own text, such as when its URDF has moved.

    Raises
    ------
    InputError : there is no record, or it does not describe its program.
    """
    record, path = load_record(result), Path(result)
    problem = problem_of(record, path, problem_file)
    summary_file = (path.parent if path.name == NUMBERS and not path.is_dir() else path) / SUMMARY
    other_summary = summary_file.exists() and read_json(summary_file) != record.summary
    return verify_record(record, problem, other_summary=other_summary)


def verify_record(record: Record, problem: ImpactProblem, *, other_summary: bool = False) -> Verdict:
    """Verdict on a record of a problem.

    other_summary : the file `summary.json` beside it is not its own.

    Raises
    ------
    InputError : it does not describe its program, or the description is damaged.
    """
    if "program_statement" not in record.arrays:
        strike = "strike_posture" in record.arrays
        why = "it is a strike, the impact alone" if strike else "it is of an impactopt before `verify`"
        raise InputError(
            f"this result has no description of its program's variables and constraints: {why}; solve again "
            "with `impactopt solve`"
        )
    found = _Found()
    if other_summary:
        found.note("summary", np.inf, SUMMARY)
        found.reasons.append(f"{SUMMARY} is not the summary in {NUMBERS}")
    try:
        made = program_of_record(record, problem)
        same = made is not None and _same_program(made, record)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        what = f"it has no {error}" if isinstance(error, KeyError) else repr(error)
        fix = "solve again with `impactopt solve`"
        raise InputError(f"this result's description of its program is damaged ({what}); {fix}") from error
    if made is None or not same:
        found.reasons.append("its program is not the one that its problem has today: solve again")
        return found.verdict(None, None)
    kkt, objective = found.program(made, record.arrays)
    for name, amount, where in _deviations(made, record):
        found.note(name, amount, where)
    return found.verdict(kkt, objective)


def _same_program(t: Transcription, record: Record) -> bool:
    """True if a program has the same variables and constraints as the record's, by name and number."""
    recorded, today = json.loads(str(record.arrays["program_statement"])), json.loads(statement_of(t))
    n, m = t.program.n, t.program.m
    sizes = {"solver_x": n, "solver_bound_multipliers": n, "solver_multipliers": m}
    return all(recorded[key] == today[key] for key in ("groups", "constraints", "components")) and all(
        len(np.atleast_1d(record.arrays[name])) == size for name, size in sizes.items()
    )


class _Found:
    """Worst violations by name, and reasons why the result is not ok."""

    def __init__(self) -> None:
        self.violations: dict[str, tuple[float, str]] = {}  # amount and place
        self.reasons: list[str] = []

    def note(self, name: str, amount: float, where: str) -> None:
        """Keep the worst violation of each name; NaN counts as infinite."""
        amount = float(amount) if np.isfinite(amount) else np.inf
        if name not in self.violations or amount > self.violations[name][0]:
            self.violations[name] = max(amount, 0.0), where

    def program(self, t: Transcription, arrays: Mapping[str, NDArray[Any]]) -> tuple[float, float]:
        """KKT residual and objective at the record's variables; violations are noted."""
        program, x = t.program, np.asarray(arrays["solver_x"], dtype=float)
        g = program.constraints(x)
        for origin, amount in zip(t.constraints.origins, constraint_violations(program, g), strict=True):
            self.note(origin.term, amount, ", ".join(filter(None, (origin.place.name, origin.component))))
        beyond = bound_violations(program, x)
        worst = int(np.argmax(beyond))
        self.note("bounds of variables", float(beyond[worst]), program.variable_name(worst))
        objective, recorded = float(program.objective(x)), float(arrays["solver_objective"])
        gap = abs(objective - recorded) / max(1.0, abs(objective))
        self.note("objective", 0.0 if gap < OBJECTIVE_TOLERANCE else gap, "solver_objective")
        y, z = (
            np.asarray(arrays[f"solver_{name}"], dtype=float) for name in ("multipliers", "bound_multipliers")
        )
        # stationarity is required of variables that are not fixed by their bounds
        free = program.x_lower < program.x_upper
        residual = np.where(free, program.gradient(x) + program.jacobian(x).T @ y + z, 0.0)
        kkt = max(scaled_residual(residual, y, z), complementarity(program, x, g, y, z))
        if not kkt <= KKT:
            name = program.variable_name(int(np.argmax(np.abs(residual))))
            self.reasons.append(f"the KKT residual is {kkt:.2g}, more than {KKT:g}; worst: {name}")
        return kkt, objective

    def verdict(self, kkt: float | None, objective: float | None) -> Verdict:
        largest_first = sorted(self.violations.items(), key=lambda item: -item[1][0])
        messages = [
            f"{name}, {where}: off by {amount:.3g}, more than {VIOLATION:g}"
            for name, (amount, where) in largest_first[:MAX_REPORTED]
            if amount > VIOLATION
        ]
        return Verdict(
            ok=not messages and not self.reasons,
            max_violation=max((amount for amount, _ in self.violations.values()), default=float("inf")),
            kkt=kkt,
            objective=objective,
            rows=self.violations,
            reason="; ".join([*messages, *self.reasons]),
        )


# ---------------------------------------------------------------- the other numbers of a record
Deviation = tuple[str, float, str]  # name of what was checked, amount, place


def _deviations(t: Transcription, record: Record) -> Iterator[Deviation]:
    """Deviations of arrays and summary from those computed from the variables, and those of the motion."""
    again = record_of(solution_of_record(record, t))
    for name in sorted(again.arrays.keys() & record.arrays.keys()):
        if name.startswith(RECOMPUTED):
            yield "record", _difference(record.arrays[name], again.arrays[name]), name
    for key in KEYS:
        if key in record.summary:
            yield from _differences(record.summary[key], again.summary.get(key), key)
    if t.problem.keeps_apart:
        clearance = again.summary["clearance_mm"]  # None: above SURVEYED
        yield "distance of bodies", -SURVEYED if clearance is None else -1e-3 * clearance, "the motion"
    for prefix in ("reference", "missed"):
        if f"{prefix}_time" in record.arrays:
            yield from motion_of_record(t.problem, record.arrays, prefix)


def _difference(recorded: Any, computed: Any) -> float:
    """Largest difference, relative to the largest number or to one; inf if shapes, texts or NaNs differ."""
    if np.asarray(computed).dtype.kind not in "fiub":
        return 0.0 if np.array_equal(recorded, computed) else np.inf
    one, two = np.asarray(recorded, dtype=float), np.asarray(computed, dtype=float)
    if one.shape != two.shape:
        return np.inf
    unknown = np.isnan(two)
    if (np.isnan(one) != unknown).any():
        return np.inf
    size = max(1.0, float(np.abs(two[~unknown]).max(initial=0.0)))
    return float(np.abs(one - two)[~unknown].max(initial=0.0)) / size


def _differences(recorded: Any, computed: Any, where: str) -> Iterator[Deviation]:
    """Relative differences of all numbers of a summary's entry; inf for another text or structure."""
    if isinstance(computed, Mapping) and isinstance(recorded, Mapping):
        for key in computed:
            yield from _differences(recorded.get(key), computed[key], f"{where}.{key}")
    elif isinstance(computed, list) and isinstance(recorded, list) and len(recorded) == len(computed):
        for k, (one, two) in enumerate(zip(recorded, computed, strict=True)):
            yield from _differences(one, two, f"{where}.{k}")
    elif isinstance(computed, float | int) and isinstance(recorded, float | int):
        yield "summary", abs(recorded - computed) / max(abs(computed), 1e-3), where
    else:
        yield "summary", 0.0 if recorded == computed else np.inf, where


def motion_of_record(
    problem: ImpactProblem, arrays: Mapping[str, NDArray[Any]], prefix: str = "reference"
) -> Iterator[Deviation]:
    """Violations of a recorded motion, by Pinocchio: rates, fixed soles, hit point, forces, and limits.

    prefix : of the arrays, "reference" or "missed".
    """
    names = ("time", "phase", "q", "v", "a", "torque")
    time, phase, q, v, a, torque = (np.asarray(arrays[f"{prefix}_{name}"]) for name in names)
    wrench = np.asarray(arrays.get(f"{prefix}_sole_wrench", np.zeros((0, 0))))
    robot, legs_of_stance = problem.robot, [c.legs for c in problem.stance_coordinates]
    model, data = robot.model, robot.model.createData()
    # Rounded cosines and sines are off the unit circle, and Pinocchio takes their small differences for zero.
    q = np.array([pin.normalize(model, at) for at in q])
    # first column of each frame's wrench
    frames = [sole.frame for sole in problem.soles] if problem.stances else problem.coordinates.frames
    columns = {frame: 6 * k for k, frame in enumerate(frames)}
    # index of the stance at each instant
    stance = np.asarray(arrays.get(f"{prefix}_stance", ()), dtype=int)
    stance = stance if stance.size else np.zeros(len(time), dtype=int)
    steps = np.flatnonzero((np.diff(time) > 0) & (np.diff(phase) == 0))
    for k in map(int, steps):
        # Euler-Maclaurin: the trapezoidal rule with its first correction
        h = time[k + 1] - time[k]
        integrated = h * (v[k] + v[k + 1]) / 2 - h**2 * (a[k + 1] - a[k]) / 12
        error = float(np.abs(pin.difference(model, q[k], q[k + 1]) - integrated).max())
        # allowed for the rule's own error: about the size of its correction, and a term of third order in h
        allowed = 0.1 * h**2 * float(np.abs(a[k + 1] - a[k]).max()) + h**3 * float(np.abs(v[k]).max() ** 2)
        yield f"{prefix}: rates", error - allowed, f"{time[k]:.4g} s"
    limit, no_base_force = robot.torque_limit, np.zeros(robot.nv - robot.n)
    scale = np.concatenate([np.full(len(no_base_force), max(1.0, weight_of(robot))), limit])
    for i, instant in enumerate(time):
        where = f"{instant:.4g} s"
        tau = robot.inverse_dynamics(data, q[i], v[i], a[i])
        pin.computeJointJacobians(model, data, q[i])
        pin.updateFramePlacements(model, data)
        for leg in legs_of_stance[stance[i]]:
            frame, at = model.getFrameId(leg.frame), columns[leg.frame]
            error = float(np.abs(pin.log6(leg.placement.actInv(data.oMf[frame])).vector).max())
            yield f"{prefix}: fixed soles", error, where
            if wrench.size:
                jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL)
                tau -= jacobian.T @ wrench[i, at : at + 6]
        # in contact the target's force is missing in the equation
        if phase[i] != CONTACT and (wrench.size or not columns):
            applied = np.concatenate([no_base_force, torque[i]])
            yield f"{prefix}: equation of motion", float(np.abs((tau - applied) / scale).max()), where
        yield f"{prefix}: torque limit", float(np.abs(torque[i] / limit).max() - 1), where
        if phase[i] != CONTACT:  # in contact the reference continues at constant velocity
            name, excess = robot.ranges.excess(robot.joint_positions(q[i : i + 1]))
            yield f"{prefix}: position limit", excess, f"{name}, {where}"
        fast = np.abs(v[i][-robot.n :]) / robot.velocity_limit
        yield f"{prefix}: velocity limit", float(fast.max() - 1), where
    if prefix == "reference" and (phase == 0).any():
        end = int(np.flatnonzero(phase == 0)[-1])
        for striker, point in problem.contacts:
            pin.framesForwardKinematics(model, data, q[end])
            at = data.oMf[model.getFrameId(f"striker:{striker}")].translation
            offset = at - point
            if problem.extra(HitRegion) is not None:  # the program's constraints are of the place in it
                offset = offset @ problem.normal
            yield "reference: hit point", float(np.abs(offset).max()), striker
