"""Gears are bounded by default: rows on them where a plan goes beyond, and nothing where it does not."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from impactopt import (
    Actuator,
    GearLoad,
    ImpactProblem,
    NotSolvedWarning,
    Perturbation,
    Scenario,
    Solution,
    load_problem,
    optimize_strike,
    solve,
    write_problem,
)
from impactopt.cli.app import app
from impactopt.files.output import record_of, save_record
from impactopt.files.replay import load_planned, resumed
from impactopt.planning.lazy_constraints import (
    gear_caution,
    gears_beyond,
    lazy_terms_of,
    with_lazy_constraints,
)
from impactopt.report.report import report_of
from impactopt.solvers.program import IterationRecord

OFF = GearLoad(enabled=False)
LIMIT = 1.8  # a plan that does not look at its gears has 2.01


def _weak(limit: float = LIMIT) -> ImpactProblem:
    """The planar arm, whose gears' momentary peaks are so many times its torque limits."""
    problem = load_problem("arm_planar")
    peaks = zip(problem.robot.joint_names, limit * problem.robot.torque_limit, strict=True)
    robot = problem.robot.with_actuators({name: Actuator(momentary_torque=peak) for name, peak in peaks})
    return replace(problem, robot=robot)


@cache
def _free(weak: bool) -> Solution:
    """The plan that does not look at its gears."""
    return solve(_with(_weak() if weak else load_problem("arm_planar"), OFF))


def _on_gears(problem: ImpactProblem) -> bool:
    return "gear_load" in lazy_terms_of(problem)


def _with(problem: ImpactProblem, term: GearLoad) -> ImpactProblem:
    return replace(problem, terms=(*problem.terms, term))


@pytest.fixture(scope="module")
def bounded() -> Solution:
    solution = solve(_weak())
    assert solution.status.usable
    return solution


@pytest.mark.slow
def test_a_plan_that_goes_beyond_gets_rows_and_goes_on(bounded: Solution) -> None:
    """To the plan that rows from the start lead to."""
    problem = _weak()
    free, own = _free(True), solve(_with(problem, GearLoad()))
    assert free.loads.gear.max() > 1.03 * LIMIT
    assert bounded.loads.gear.max() == pytest.approx(LIMIT, rel=0.03)
    assert bounded.impulse == pytest.approx(own.impulse, rel=1e-4) and bounded.impulse < free.impulse
    assert _on_gears(bounded.problem) and bounded.summary()["rows_on_demand"]
    assert bounded.result.iterations > free.result.iterations, "the effort of both"


@pytest.mark.filterwarnings("ignore::impactopt.errors.NotSolvedWarning")
@pytest.mark.parametrize(("limit", "again"), [(LIMIT, False), (1.2, True)])
def test_a_gear_far_beyond_sends_it_back_to_the_initial_guess(limit: float, again: bool) -> None:
    records = list[IterationRecord]()

    def second(record: IterationRecord) -> bool:
        records.append(record)
        return record.iteration == 0 and len(records) > 1

    solve(_weak(limit), callback=second)
    first, *_, last, new = (record.objective for record in records)
    assert new == pytest.approx(first if again else last, rel=1e-3)
    assert first != pytest.approx(last, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
def test_it_holds_in_replays(bounded: Solution, engine: str) -> None:
    found = bounded.validate(engine=engine)
    assert found.loads.gear.max() == pytest.approx(bounded.loads.gear.max(), rel=0.05)


@pytest.mark.slow
def test_a_plan_is_bounded_as_soon_as_it_exceeds_the_limit() -> None:
    """A limit just above the plan's load changes nothing; one half a percent below it does."""
    free = _free(False)
    most = free.loads.gear.max()
    kept, less = (solve(_weak(share * most)) for share in (1.0005, 0.995))
    np.testing.assert_array_equal(kept.result.x, free.result.x)
    assert not _on_gears(kept.problem) and not kept.summary()["rows_on_demand"]
    assert _on_gears(less.problem) and less.loads.gear.max() < most


@pytest.mark.slow
def test_no_blow_within_the_limit_is_told() -> None:
    """Held firmly, the hammer passes the nail's resistance on.

    Which rows the point of least violation leaves off is a matter of rounding; what would do is not.
    """
    with pytest.warns(NotSolvedWarning):
        found = solve(_weak(0.8))
    assert not found.status.usable
    assert found.violations
    assert "Without [terms.gear_load] there is a plan, but gear of wrist: 2.01" in found.result.message


@pytest.mark.slow
def test_a_strike_is_bounded_too() -> None:
    free, kept = (optimize_strike(p) for p in (_with(_weak(), OFF), _weak()))
    assert free.strike.loads().gear.max() > 1.03 * LIMIT
    assert kept.strike.loads().gear.max() == pytest.approx(LIMIT, rel=1e-3)
    assert kept.impulse < free.impulse
    again = optimize_strike(_weak(), start=kept)
    assert again.impulse == pytest.approx(kept.impulse, rel=1e-4) and _on_gears(again.problem)


@pytest.mark.slow
def test_scenarios_count() -> None:
    """Steel that damps more than the expected one makes a larger force at once."""
    damped = Scenario(name="damped", damping=1.6)
    problem = replace(load_problem("arm_planar"), scenarios=(damped,))
    free = solve(_with(problem, OFF))
    hit = free.plan.scenarios[0].collision
    load = np.abs(hit.torque - problem.robot.armature * hit.acceleration) / problem.robot.torque_limit
    assert load.max() > 1.03 * 2.0 > free.loads.gear.max()
    assert _on_gears(solve(problem).problem)


@pytest.mark.slow
def test_a_neighbour_goes_on_with_the_rows(bounded: Solution) -> None:
    """And one that gets rows of its own from a plan that has none."""
    nearer = replace(bounded.problem, point=bounded.problem.point - [0.01, 0, 0], terms=_weak().terms)
    found = solve(nearer, start=bounded)
    assert found.status.usable and _on_gears(found.problem)
    assert found.result.iterations < bounded.result.iterations
    kept = solve(_with(_weak(), GearLoad()), start=_free(True))
    assert kept.impulse == pytest.approx(bounded.impulse, rel=1e-3)


@pytest.mark.slow
def test_a_moved_plan_gets_rows_where_it_needs_them() -> None:
    """A limit just above what the plan asks for, and steel that damps more."""
    problem = _weak(1.02 * 2.01)
    near = solve(problem)
    assert near.status.usable and not _on_gears(near.problem)
    more = 1.5 * near.problem.law.parameters["damping"]
    moved = near.moved(damping=more)
    assert moved.status.usable and _on_gears(moved.problem)
    assert moved.loads.gear.max() == pytest.approx(1.02 * 2.01, rel=0.03)


def test_a_saved_plan_is_made_again_with_its_rows(bounded: Solution, tmp_path: Path) -> None:
    text = write_problem(_weak())
    assert "[terms.gear_load]" not in text
    save_record(record_of(bounded, problem=text), tmp_path)
    planned = load_planned(tmp_path)
    assert _on_gears(planned.problem)
    again = resumed(planned.record, planned.problem)
    np.testing.assert_array_equal(again.result.x, bounded.result.x)


def test_a_first_touch_that_is_off_is_said() -> None:
    """A draft switches it off for arms of few joints: one hit with another part, 59 mm in the target."""
    setting = ["--set", "terms.first_touch.enabled=false"]
    said = CliRunner().invoke(app, ["check", "arm_planar", *setting]).output
    assert "off" in said and "first touch" in said
    assert "first touch" not in CliRunner().invoke(app, ["check", "arm_planar"]).output


@pytest.mark.slow
def test_what_is_off_is_said(tmp_path: Path) -> None:
    """By `check`, in the result and on the page."""
    runner = CliRunner()
    setting = ["--set", "terms.gear_load.enabled=false"]
    said = runner.invoke(app, ["check", "arm_planar", *setting]).output
    assert "off" in said and "gear load" in said
    assert "gear load" not in runner.invoke(app, ["check", "arm_planar"]).output
    told = runner.invoke(app, ["solve", "arm_planar", *setting, "--no-validate", "--out", str(tmp_path)])
    assert "switched off: gear load" in told.output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["problem"]["off"] == ["gear load"]
    assert summary["gear_caution"].endswith("bound it with [terms.gear_load]")
    assert ">gear load</td>" in report_of(record_of(_free(False))).html


def test_what_gears_bear_at_most_is_part_of_the_problem() -> None:
    """Of one that bounds them; another is not changed by it."""
    strong, weak = load_problem("arm_planar"), _weak()
    assert strong.hash != weak.hash
    assert _with(strong, OFF).hash == _with(weak, OFF).hash
    assert with_lazy_constraints(_with(weak, OFF), ["gear_load"]).gear_load == OFF


@pytest.mark.slow
def test_a_replay_that_goes_beyond_is_told(bounded: Solution) -> None:
    """A harder world than the plan's."""
    assert not gear_caution(bounded.problem, [bounded.loads])
    harder = bounded.validate(engine="mujoco", perturbation=Perturbation(mass=4.0, stiffness=4.0))
    assert harder.loads.gear.max() > 1.1 * LIMIT
    text = gear_caution(bounded.problem, [bounded.loads, harder.loads])["gear_caution"]
    assert text.startswith("gear of wrist") and "at most 1.8 allowed" in text
    assert gears_beyond(bounded.problem, [bounded.loads], more=0.03) == ""
