"""The strike by shooting: slopes, what it predicts against the SDC itself, and what it refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import arm_problem, biped_problem, transcribed

from impactopt import load_problem, optimize_strike
from impactopt.collision import SDC
from impactopt.errors import InputError
from impactopt.planning.keeping_apart import Margins, Watch
from impactopt.problem.objectives import Penetration
from impactopt.problem.problem import ImpactProblem
from impactopt.transcription.start import carried_over, strike_iterate
from impactopt.transcription.strike import ShootingStrike
from impactopt.transcription.transcription import block_functions

Array = NDArray[np.float64]


def of(problem: ImpactProblem) -> ShootingStrike:
    c = problem.coordinates
    return ShootingStrike(problem, c, block_functions(problem, c))


@pytest.mark.parametrize("robot", ["arm", "biped"])
def test_slopes_agree_with_differences(robot: str) -> None:
    if robot == "arm":
        t = of(load_problem("arm_planar"))
    else:
        whole = transcribed(biped_problem())
        t = ShootingStrike(whole.problem, whole.coordinates, whole.functions)
    program, x = t.program, strike_iterate(t)
    slopes, h = program.jacobian(x).toarray(), 1e-6
    for j in range(program.n):
        e = h * np.eye(program.n)[j]
        column = (program.constraints(x + e) - program.constraints(x - e)) / (2 * h)
        # what is left of the collision's own steps is a relative 1e-7, over h
        np.testing.assert_allclose(slopes[:, j], column, rtol=2e-3, atol=2e-3)


def test_a_result_starts_a_program_with_more_rows_between_bodies() -> None:
    t = of(load_problem("arm_planar"))
    x = strike_iterate(t)
    rows = Watch(t, Margins(t.problem), x).rows(1.0)
    finer, multipliers = t.with_apart(rows), np.arange(1.0, t.program.m + 1)
    new, y, _ = carried_over(finer, t, x, multipliers, np.zeros(len(x)))
    assert rows
    np.testing.assert_allclose(new, x, atol=1e-9)
    np.testing.assert_array_equal(y, [*multipliers, *np.zeros(len(rows))])


def test_it_predicts_what_the_sdc_does() -> None:
    problem = load_problem("arm_planar")
    found = optimize_strike(problem, method="shooting")
    assert found.status.usable
    told = found.summary()
    assert told["collision_model"] == "sdc" and abs(told["model_error_pct"]) < 1.0
    hit = found.strike
    sdc = SDC(
        robot=problem.robot,
        striker=problem.striker,
        normal=problem.normal,
        law=problem.law,
        target=problem.target,
        horizon=0.03,
    )
    alone = sdc.collide(hit.posture, hit.velocity, hit.torque)
    assert hit.impulse == pytest.approx(alone.impulse, rel=1e-5)
    assert hit.compression + hit.restitution == pytest.approx(alone.duration, rel=1e-5)
    assert np.abs(hit.collision.torque / problem.robot.torque_limit).max() <= 0.85 + 1e-6
    again = optimize_strike(problem, method="shooting", start=found)
    assert again.impulse == pytest.approx(hit.impulse, rel=1e-4)
    with pytest.raises(InputError, match="shooting has other variables"):
        optimize_strike(problem, start=found)
    # the whole equation of motion says the same of a hammer's blow
    assert hit.impulse == pytest.approx(optimize_strike(problem).impulse, rel=0.02)


def test_rows_hold_from_the_first_touch_on() -> None:
    """A damped contact jumps to its force at once, and soles bear most in the milliseconds after that."""
    t = of(biped_problem())
    rows = [t.program.row_name(i) for i in range(t.program.m)]
    x, shot = strike_iterate(t), t.hit.expected
    found = shot.shooting.collide(shot._z.evaluate(x))
    assert found["time"][0] == 0.0 and found["force"][0] > 1.0
    first = shot.shooting.value(shot._z.evaluate(x))[shot.shooting.parts["cone"]]
    wrench = found["sole_wrench"][0] @ shot.shooting._cone.T
    np.testing.assert_allclose(first[: len(wrench)], wrench, rtol=1e-9, atol=1e-12)
    for term in ("contact wrench cone", "torque limit in collision"):
        assert any(row.startswith(term) and "instant 0" in row for row in rows)


def test_what_has_no_slopes_is_refused() -> None:
    with pytest.raises(InputError, match="breaks"):
        optimize_strike(load_problem("chop_arm"), method="shooting")
    problem = arm_problem()
    deepest = dataclasses.replace(problem, objectives=(Penetration(weight=-1.0),))
    with pytest.raises(InputError, match="penetration"):
        optimize_strike(deepest, method="shooting")
    with pytest.raises(InputError, match="ipopt"):
        optimize_strike(problem, method="shooting", solver="ipopt")
    with pytest.raises(InputError, match="hessian"):
        optimize_strike(problem, method="shooting", options={"hessian": "exact"})
    with pytest.raises(InputError, match="did you mean 'shooting'"):
        optimize_strike(problem, method="shoting")
