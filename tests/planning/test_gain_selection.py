"""Gains that a plan chooses: its program, what it chooses, and what comes after."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support.small_plans import rod_hammer

from impactopt import (
    FreeMass,
    GainFactor,
    ImpactProblem,
    InputError,
    SoftGrip,
    Solution,
    load_problem,
    load_record,
    load_solution,
    optimize_strike,
    scaled_gains,
    solve,
    write_problem,
)
from impactopt.files.output import record_of, save_record
from impactopt.files.problem_file import ProblemFile
from impactopt.files.replay import problem_of, resumed
from impactopt.files.verify import verify
from impactopt.planning.gain_selection import with_room_for_gains
from impactopt.planning.models import carried_start
from impactopt.planning.solution import program_of
from impactopt.report.result_rows import result_columns, result_rows
from impactopt.robots.gains import with_room
from impactopt.solvers.program import max_violation
from impactopt.transcription import contact_conditions
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.transcription import Transcription, block_functions

GRIP = SoftGrip(axis=[0, 1, 0], stiffness=20.0, damping=0.5, point=[0.0, 0.0, 0.08])
HAND, BETWEEN = "hammer_grip", (0.1, 10.0)


def _soft() -> ImpactProblem:
    firm = rod_hammer(load_problem("arm_planar"))
    return replace(
        firm,
        robot=firm.robot.with_grip("hammer", GRIP),
        swing=replace(firm.swing, intervals=24),
        follow=replace(firm.follow, intervals=16),
    )


def _open(*joints: str, between: tuple[float, float] = BETWEEN) -> tuple[GainFactor, ...]:
    return (GainFactor(joints=joints, factor=between),)


def _worth(solution: Solution) -> float:
    """Energy in the target [J], which is what is maximized."""
    return float(solution.objectives["target energy"])


@pytest.fixture(scope="module", autouse=True)
def slow_parting() -> Iterator[None]:
    """A hammer in a soft hand has to leave the nail fast, and that has several optima; gains are looked at
    here about one of them.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact_conditions, "SOFT_GRIP_RATE", contact_conditions.CLEARANCE_RATE)
        yield


@pytest.fixture(scope="module")
def chosen() -> Solution:
    solution = solve(replace(_soft(), gains=_open(HAND), style="strongest"))  # prices would count too
    assert solution.status.usable
    return solution


@pytest.mark.parametrize(
    ("joints", "factor", "changes"),
    [
        (("shoulder", "wrist"), 0.3, {}),
        ((HAND,), 3.0, {}),
        (("*",), 1.7, {}),
        (("elbow", HAND), 0.6, {"collision": "sdc", "freezes": 1}),
    ],
)
def test_a_program_that_chooses_gains_has_the_rows_of_a_robot_that_has_them(
    joints: tuple[str, ...], factor: float, changes: dict[str, str | int]
) -> None:
    given = replace(_soft(), **changes)  # type: ignore[arg-type]
    robot = with_room(given.robot, dict.fromkeys(joints, 10.0))
    free = _program(replace(given, robot=robot, gains=_open(*joints)))
    there = scaled_gains(given.robot, dict.fromkeys(joints, factor))
    own = _program(replace(given, robot=replace(there, torque_limit=robot.torque_limit)))
    at = free.hit.contact.gains.index(0)
    x = first_iterate(own, noise=0.2, seed=3)
    z = np.insert(x, at[0], np.log(factor))
    np.testing.assert_allclose(free.program.constraints(z), own.program.constraints(x), atol=1e-9)
    step = np.zeros(len(z))
    step[at] = 1e-6
    slope = (free.program.constraints(z + step) - free.program.constraints(z - step)) / 2e-6
    found = free.program.jacobian(z).toarray()[:, at[0]]
    assert np.abs(found).max() > 1e-3
    np.testing.assert_allclose(found, slope, atol=1e-6)


def _program(problem: ImpactProblem) -> Transcription:
    return Transcription(problem, block_functions(problem))


@pytest.mark.slow
def test_no_other_stiffness_is_better(chosen: Solution) -> None:
    """Inside the bounds, so that the worth is level there: it falls each way, by the square of the way."""
    (own,) = chosen.gains
    assert not own.at_bound and 0.2 < own.factor < 2.0
    lost = []
    for more in (0.7, 0.85, 1 / 0.85, 1 / 0.7):
        robot = scaled_gains(chosen.problem.robot, {HAND: more})
        other = solve(replace(chosen.problem, robot=robot), start=chosen)
        assert other.status.usable
        lost.append(_worth(chosen) - _worth(other))
    assert min(lost) > 0
    assert lost[1] < 0.5 * lost[0] and lost[2] < 0.5 * lost[3]


@pytest.mark.slow
def test_it_brings_more_than_the_stiffness_that_is_given(chosen: Solution) -> None:
    assert _worth(chosen) > 1.02 * _worth(solve(_soft()))


@pytest.mark.slow
def test_what_comes_after_has_the_gains_that_are_chosen(chosen: Solution) -> None:
    (own,) = chosen.gains
    robot, at = chosen.problem.robot, chosen.problem.robot.joint_index(HAND)
    assert chosen.problem.gains == ()
    assert robot.kp[at] == pytest.approx(20.0 * own.factor) == own.stiffness[HAND]
    assert robot.kd[at] == pytest.approx(0.5 * np.sqrt(own.factor)) == own.damping[HAND]
    (grip,) = (tool.grip for tool in robot.tools)
    assert grip is not None and (grip.stiffness, grip.damping) == (robot.kp[at], robot.kd[at])
    for engine in ("pinocchio", "mujoco"):
        replay = chosen.validate(engine=engine)
        assert replay.impulse == pytest.approx(chosen.impulse, rel=0.01)
        depth = chosen.plan.collision.outcome["depth_m"]
        assert replay.outcome["depth_m"] == pytest.approx(depth, rel=0.02)


@pytest.mark.slow
def test_a_file_leaves_gains_open_and_its_result_says_which(tmp_path: Path) -> None:
    text = write_problem(replace(_soft(), gains=_open(HAND)))
    read = ProblemFile.parse(text, tmp_path / "soft.toml")
    problem = read.build()
    assert problem.gains == _open(HAND)
    solution = solve(problem, refine=False)
    record = record_of(solution, problem=text, problem_path=tmp_path / "soft.toml")
    save_record(record, tmp_path)
    kept = load_record(tmp_path)
    again = problem_of(kept, tmp_path)
    assert again.hash == solution.problem.hash
    assert resumed(kept, again).gains == solution.gains == solution.moved(damping=210.0).gains
    (told,) = kept.summary["gains"]
    assert told["joints"] == [HAND] and told["between"] == list(BETWEEN)
    rows = result_rows(result_columns(kept.summary))
    label, row = next((r.label, r.cells[0].text) for r in rows if r.label.startswith("stiffness"))
    assert "0.1 to 10" in label and float(row) == pytest.approx(told["factor"], rel=1e-2)
    (tmp_path / "open.toml").write_text(text, "utf-8")
    assert problem_of(kept, tmp_path, tmp_path / "open.toml").hash == again.hash
    verdict = verify(tmp_path)
    assert verdict.ok and verdict.kkt < 1e-5


@pytest.mark.slow
def test_a_solution_is_saved_with_the_gains_that_it_has_chosen(tmp_path: Path) -> None:
    """Its own problem, whose text it is saved with, has no open gains any more."""
    solution = solve(replace(load_problem("arm_planar"), gains=_open("*", between=(0.7, 1.3))), refine=False)
    kept = load_solution(solution.save(tmp_path))
    assert kept.gains == solution.gains != ()
    np.testing.assert_allclose(kept.problem.robot.kp, solution.problem.robot.kp, rtol=1e-12)


@pytest.mark.slow
def test_another_problem_chooses_gains_of_its_own(tmp_path: Path) -> None:
    """It was taken for the plan's, with gains beyond its range; two open gains for one were a traceback."""
    arm, saved, file = load_problem("arm_planar"), tmp_path / "saved", tmp_path / "other.toml"
    solution = solve(replace(arm, gains=_open("*", between=(0.7, 0.8))), refine=False)
    solution.save(saved)
    for gains in (
        _open("*", between=(0.9, 1.1)),
        (*_open("shoulder", between=(0.9, 1.1)), *_open("elbow", between=(0.9, 1.1))),
    ):
        file.write_text(write_problem(replace(arm, gains=gains)), encoding="utf-8")
        found = load_solution(saved, problem_file=file)
        assert found.status.usable
        assert [0.9 <= one.factor <= 1.1 for one in found.gains] == [True] * len(gains)


@pytest.mark.slow
def test_gains_of_servos_are_chosen_too() -> None:
    """A strike that may choose is better than the one that it starts from, which may not."""
    arm = load_problem("arm7")
    own = optimize_strike(arm)
    free = optimize_strike(replace(arm, gains=_open("joint_*")), start=own)
    assert free.status.usable
    (found,) = free.gains
    assert free.objectives["target energy"] > own.objectives["target energy"]
    np.testing.assert_allclose(free.problem.robot.kp, found.factor * arm.robot.kp)
    np.testing.assert_allclose(free.problem.robot.kd, np.sqrt(found.factor) * arm.robot.kd)


@pytest.mark.slow
def test_two_factors_are_chosen_each_in_its_bounds_and_noisy_starts_draw_them() -> None:
    gains = (*_open("joint_[1-4]", between=(0.5, 2.0)), *_open("joint_[5-7]", between=(0.2, 0.9)))
    arm = replace(load_problem("arm7"), gains=gains)
    t = _program(arm)
    plain, noisy = (t.hit.contact.gains.read(first_iterate(t, noise=n, seed=1))[0] for n in (0.0, 0.3))
    np.testing.assert_allclose(np.exp(plain), [1.0, 0.9])
    assert (
        np.all(noisy != plain) and np.all(np.exp(noisy) > [0.5, 0.2]) and np.all(np.exp(noisy) < [2.0, 0.9])
    )
    strike = optimize_strike(arm)
    assert strike.status.usable
    first, second = strike.gains
    assert first.joints == tuple(f"joint_{k}" for k in range(1, 5)) and 0.5 <= first.factor <= 2.0
    assert second.joints == tuple(f"joint_{k}" for k in range(5, 8)) and 0.2 <= second.factor <= 0.9


@pytest.mark.slow
def test_a_plan_goes_on_from_one_that_has_chosen(chosen: Solution) -> None:
    """Gains begin where that one has them, with all rows met."""
    problem = with_room_for_gains(replace(_soft(), gains=_open(HAND)))
    t = _program(problem)
    start = carried_start(t, partial(program_of, chosen), chosen, {})
    np.testing.assert_allclose(np.exp(t.hit.contact.gains.read(start.x)), [[chosen.gains[0].factor]])
    assert max_violation(t.program, start.x, t.program.constraints(start.x)) < 1e-6
    again = solve(replace(_soft(), gains=_open(HAND)), start=chosen)
    assert again.status.usable
    assert _worth(again) > 0.999 * _worth(chosen)


def test_a_robot_with_other_gains_is_one_with_another_grip() -> None:
    firm = load_problem("arm_planar").robot
    other = dataclasses.replace(GRIP, stiffness=60.0, damping=0.5 * np.sqrt(3.0))
    mine, its = scaled_gains(firm.with_grip("hammer", GRIP), {HAND: 3.0}), firm.with_grip("hammer", other)
    for name in ("kp", "kd", "torque_limit"):
        np.testing.assert_allclose(getattr(mine, name), getattr(its, name), rtol=1e-12)


@pytest.mark.parametrize(
    ("gains", "words"),
    [
        (_open("finger"), "no joint is called 'finger'"),
        (_open("wrist", "el*") + _open("elbow"), "joint 'elbow' is in two of them"),
        (["wrist"], "must be a tuple of GainFactor"),
    ],
)
def test_gains_that_no_plan_can_choose_are_refused(gains: tuple[GainFactor, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(_soft(), gains=gains)


def test_the_largest_gains_are_not_too_fast() -> None:
    soft = _soft()
    stiff = scaled_gains(soft.robot, {"wrist": 1e3})
    with pytest.raises(InputError, match="servo of joint 'wrist'"):
        replace(soft, robot=stiff, gains=_open("wrist", between=(1.0, 1e3)))


def test_contacts_without_time_have_no_gains_to_choose() -> None:
    arm = load_problem("arm7")
    bare = replace(arm, target=FreeMass(mass=1.0), objectives=ImpactProblem.objectives)
    with pytest.raises(InputError, match="no duration"):
        replace(bare, collision="rigid", gains=_open("joint_1"))


@pytest.mark.parametrize("factor", [(1.0, 1.0), (2.0, 1.0), (0.0, 1.0), (1.0, np.inf), (1.0, 1e4)])
def test_a_factor_leaves_a_choice(factor: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="factor"):
        GainFactor(joints=("wrist",), factor=factor)


@pytest.mark.parametrize("factor", [0.5, np.int64(2)])
def test_one_number_as_a_factor_is_refused_with_the_function_that_takes_it(factor: object) -> None:
    """A file takes one, so a user tries it here, too."""
    with pytest.raises(InputError, match="for one number take scaled_gains"):
        GainFactor(joints=("wrist",), factor=factor)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        ("[4.0]", r"\[least, largest\]"),
        ("[2.0, 1.0]", "less than the second"),
        ("0.0", "a number > 0"),
        ('"soft"', "a number > 0"),
        ("1e4", "0.001 to 1000"),
        ("[1.0, 1e4]", "least < largest <= 1000"),
    ],
)
def test_a_file_with_a_factor_that_is_none_is_refused(tmp_path: Path, factor: str, words: str) -> None:
    text = write_problem(replace(_soft(), gains=_open(HAND))).replace("[0.1, 10.0]", factor)
    with pytest.raises(InputError, match=words):
        ProblemFile.parse(text, tmp_path / "soft.toml").build()
