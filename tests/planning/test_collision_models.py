"""One name, one prediction: models of the collision inside plans, and the same models on their own."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import arm_problem, biped_problem, struck, transcribed
from typer.testing import CliRunner

from impactopt import (
    ContactFriction,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    ImpactProblem,
    Impulse,
    InputError,
    KelvinVoigt,
    NotSolvedWarning,
    RigidWall,
    Scenario,
    SpringDamper,
    Status,
    coasting_reference,
    load_problem,
    optimize_strike,
    solve,
)
from impactopt.cli.app import app
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.sdc import FROZEN, frozen_model
from impactopt.planning.budget import Budget
from impactopt.planning.models import climbed, good_enough
from impactopt.planning.solution import ModelError
from impactopt.problem.problem import COLLISIONS
from impactopt.solvers.ipm import solve_ipm
from impactopt.transcription.initial_guess import first_iterate, strike_iterate, warm_start
from impactopt.transcription.mesh import contact_elements, guessed_shares, place_of
from impactopt.transcription.plan import PlannedStrike
from impactopt.transcription.strike import StrikeTranscription

pytestmark = [
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
]

Array = NDArray[np.float64]
# fine enough that collocation does not count: what is left is the model
FINE = ((0.02, 0.06, 0.12, 0.2, 0.3, 0.3), (0.25, 0.25, 0.25, 0.25))
# and of a robot whose light wrist's servo is fast
FINER = ((0.004, 0.012, 0.024, 0.06, 0.15, 0.25, 0.25, 0.25), (0.25, 0.25, 0.25, 0.25))
IMPULSE, ZMP = 1e-4, 0.1  # relative; [mm]


def planned(problem: ImpactProblem) -> tuple[StrikeTranscription, PlannedStrike]:
    """The strike of a problem, and its program."""
    t = struck(problem)
    x = strike_iterate(t)
    for _ in range(3):  # shares of the phases are others at another optimum
        result = solve_ipm(t.program, x)
        assert result.status.usable
        shares = t.hit.drifted(result.x)
        if shares is None:
            return t, t.decode(result.x)
        old, elements = t, contact_elements(problem, shares)
        t = StrikeTranscription(problem, t.functions, elements, shares)
        x = warm_start(t, old, result.x, result.multipliers, result.bound_multipliers)[0]
    pytest.fail("the shares of the phases do not settle")


def alone(strike: PlannedStrike, *, step: float = 1e-3) -> Any:
    """The collision of the model of that name, from the strike's state at contact."""
    p = strike.problem
    names = ("robot", "striker", "normal", "law", "target", "stance")
    model = frozen_model(p.collision, p.freezes, **{name: getattr(p, name) for name in names})
    model = dataclasses.replace(model, step=step)
    until = 2 * max(strike.compression + strike.restitution, 1e-3)
    bend = coasting_reference(p.coordinates, strike.posture, strike.velocity, until=until)
    known = {name: x for name, x in bend.items() if name in model.settings}
    return model.collide(strike.posture, strike.velocity, strike.torque, **known)


def zmp_apart(strike: PlannedStrike, found: Any) -> Array:
    """[mm] at the plan's collocation points that the other contact has too."""
    hit = strike.collision
    there = hit.time[1:] < found.time[-1]
    ground = np.stack([np.interp(hit.time[1:], found.time, w) for w in found.ground_wrench.T], axis=1)
    own, other = (np.stack([-w[:, 4], w[:, 3]]) / w[:, 2] for w in (hit.ground[there], ground[there]))
    return np.asarray(1e3 * np.linalg.norm(own - other, axis=0))


SPRING, KELVIN = SpringDamper(stiffness=1e4, damping=300.0), KelvinVoigt(stiffness=2e4, damping=30.0)
BALL = FreeMass(mass=3.0)
MET = {
    "spring-damper": (SPRING, BALL),
    "Kelvin-Voigt": (KELVIN, BALL),
    "Hunt-Crossley": (HuntCrossley(stiffness=3e5, dissipation=0.3), BALL),
    "Hertz": (HertzDamped(stiffness=2e5, damping=100.0), BALL),
    "wall": (SPRING, RigidWall()),
}
CASES = [(name, "sdc", 0) for name in MET]
CASES += [("spring-damper", model, n) for model, n in (("virtual-mass", 0), ("sdc-paper", 0), ("sdc", 1))]
CASES.append(("Hunt-Crossley", "sdc", 3))


@pytest.mark.parametrize(("met", "model", "freezes"), CASES)
def test_a_plan_and_its_model_agree(met: str, model: str, freezes: int) -> None:
    """On a small arm, for all laws and targets."""
    law, target = MET[met]
    changes: dict[str, Any] = {"law": law, "target": target, "collision": model, "freezes": freezes}
    if not target.n_states:  # a push at a wall need not end
        changes["contact_duration"] = (0.0, 0.02)
    problem = dataclasses.replace(arm_problem(), collision_elements=FINE, **changes)
    _, strike = planned(problem)
    found = alone(strike)
    assert strike.impulse == pytest.approx(found.impulse, rel=IMPULSE)
    if model != "virtual-mass":
        assert strike.compression + strike.restitution == pytest.approx(found.duration, rel=1e-3)
        if not target.n_states:
            return
        # and no other model does
        other = "sdc" if model == "sdc-paper" or freezes else "sdc-paper"
        changed = dataclasses.replace(problem, collision=other, freezes=0)
        off = alone(dataclasses.replace(strike, problem=changed)).impulse / strike.impulse - 1
        assert abs(off) > 5 * IMPULSE


@pytest.mark.parametrize("model", ["sdc-paper", "sdc"])
def test_the_servo_keeps_its_torque_in_contact(model: str) -> None:
    """The paper's model leaves out the torque that balances gravity, but a replay has gravity."""
    reference = solve(dataclasses.replace(arm_problem(), collision=model)).plan.reference
    robot, k = arm_problem().robot, int(np.flatnonzero(reference.phase == 1)[0])
    coasting = robot.inverse_dynamics(
        robot.model.createData(), reference.q[k], reference.v[k], 0 * reference.v[k]
    )
    np.testing.assert_allclose(reference.torque[k], coasting, atol=1e-9 * np.abs(coasting).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "model", "freezes"),
    [
        ("arm_planar", "sdc", 0),
        ("arm_planar", "sdc", 4),
        ("chop_arm", "sdc", 0),
        ("arm7", "sdc-paper", 0),
    ],
)
def test_nails_and_boards_too(name: str, model: str, freezes: int) -> None:
    problem = dataclasses.replace(
        load_problem(name), collision=model, freezes=freezes, collision_elements=FINE
    )
    solution = optimize_strike(problem)
    assert solution.status.usable
    found = alone(solution.strike)
    assert solution.impulse == pytest.approx(found.impulse, rel=IMPULSE)


def test_scenarios_are_frozen_too() -> None:
    """Each meets its own target, from the same state at contact."""
    heavy = Scenario(name="heavy", mass=2.0)
    problem = dataclasses.replace(arm_problem(), collision="sdc", collision_elements=FINE, scenarios=(heavy,))
    _, strike = planned(problem)
    (other,) = strike.scenarios
    assert strike.impulse == pytest.approx(alone(strike).impulse, rel=IMPULSE)
    target = FreeMass(**heavy.numbers(problem.law, problem.target)[1])
    met = dataclasses.replace(problem, target=target, scenarios=())
    found = alone(dataclasses.replace(strike, problem=met))
    assert other.impulse == pytest.approx(found.impulse, rel=IMPULSE)
    assert abs(other.impulse / strike.impulse - 1) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("model", "step"), [("sdc-paper", 2e-5), ("sdc", 1e-4)])
def test_weight_and_legs(model: str, step: float) -> None:
    """The small biped's ZMP: its wrenches have the weight that the paper's model leaves out; frozen at
    contact, a leg's servo follows a reference that bends.
    """
    problem = dataclasses.replace(biped_problem(), collision=model, collision_elements=FINER)
    _, strike = planned(problem)
    found = alone(strike, step=step)
    assert strike.impulse == pytest.approx(found.impulse, rel=IMPULSE)
    assert zmp_apart(strike, found).max() < ZMP


# ---------------------------------------------------------------- the cheapest that is good enough
RUNS = {"solve": solve, "strike": optimize_strike}


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS.values(), ids=RUNS)
def test_auto_takes_what_is_good_enough(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = dataclasses.replace(load_problem("arm_planar"), collision="auto")
    cheap = run(problem)
    error = cheap.model_error
    assert cheap.problem.collision == "sdc" and cheap.status.usable
    assert 0.05 < abs(error.impulse_pct) <= problem.auto_impulse_pct
    # what it says is off is what a plan with all in it says
    dear = run(dataclasses.replace(problem, collision="full"))
    assert dear.model_error is None
    summary = cheap.summary()
    assert (summary["collision_model"], summary["model_error_pct"]) == ("sdc", error.impulse_pct)
    assert (dear.summary()["collision_model"], dear.summary()["model_error_pct"]) == ("full", None)
    strict = dataclasses.replace(problem, auto_impulse_pct=0.05)
    monkeypatch.setattr("impactopt.planning.models._skips_first", lambda *_: False)
    climbed = run(strict)
    assert climbed.problem.collision == "full" and climbed.model_error is None
    assert climbed.impulse == pytest.approx(dear.impulse, rel=1e-5)
    first, last = climbed.attempts
    assert last.kept and not first.kept and last.iterations < 0.7 * dear.result.iterations


def test_compiling_the_first_model_takes_no_time_from_the_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impactopt.planning.models._skips_first", lambda *_: False)
    problem = dataclasses.replace(load_problem("arm_planar"), collision="auto", auto_impulse_pct=0.05)
    cheap = optimize_strike(dataclasses.replace(problem, collision="sdc"))
    given: list[float | None] = []

    def run(_: ImpactProblem, start: Any, budget: Budget) -> Any:
        given.append(budget.time_limit)
        time.sleep(0.05)  # longer than the limit
        return dataclasses.replace(cheap, build_seconds=0.04, solve_seconds=0.01)

    budget = Budget(solver="ipm", options=None, time_limit=0.03, callback=None)
    assert climbed(problem, run, budget).build_seconds == pytest.approx(0.08)
    assert given == [pytest.approx(0.03), pytest.approx(0.02)]


@pytest.mark.parametrize(
    ("make", "before", "after"),
    [
        (arm_problem, {"collision": "virtual-mass"}, {"collision": "sdc"}),
        (arm_problem, {"collision": "rigid"}, {"collision": "full"}),
        (arm_problem, {"collision": "sdc", "freezes": 2}, {"collision": "sdc", "freezes": 5}),
        (arm_problem, {"collision": "full"}, {"collision": "sdc", "freezes": 5}),
        (biped_problem, {"collision": "sdc", "freezes": 3}, {"collision": "sdc", "freezes": 2}),
    ],
    ids=lambda given: given.__name__ if callable(given) else " ".join(map(str, given.values())),
)
def test_a_warm_start_of_another_model_has_a_contact(
    make: Callable[[], ImpactProblem], before: dict[str, Any], after: dict[str, Any]
) -> None:
    target = FreeMass(mass=3.0)
    problem = dataclasses.replace(make(), law=SpringDamper(stiffness=1e5, damping=50.0), target=target)
    old, new = (transcribed(dataclasses.replace(problem, **each)) for each in (before, after))
    x, *_ = warm_start(new, old, first_iterate(old), np.zeros(old.program.m), np.zeros(old.program.n))
    contact = new.decode(x).collision
    # the force's integral is the impulse, and what the target gains
    assert np.trapezoid(contact.force, contact.time) == pytest.approx(new.impulse(x), rel=0.1)
    assert target.mass * contact.outcome["speed_m_s"] == pytest.approx(new.impulse(x), rel=1e-3)
    assert new.impulse(x) > 0.1


@pytest.mark.slow
def test_a_solution_with_friction_starts_one_without() -> None:
    friction = ContactFriction(coefficient=0.3, stiffness=1e5)  # bristles are variables of the program
    problem = dataclasses.replace(arm_problem(), friction=friction)
    given = solve(problem, refine=False)
    found = solve(dataclasses.replace(problem, friction=None), start=given, refine=False)
    assert found.status is Status.SOLVED
    assert found.impulse == pytest.approx(given.impulse, rel=0.1)


def test_auto_skips_what_cannot_do() -> None:
    said: list[str] = []
    problem = dataclasses.replace(load_problem("arm_planar"), collision="auto", auto_impulse_pct=1e-4)
    found = optimize_strike(problem, report=said.append)
    assert found.problem.collision == "full" and len(found.attempts) == 1
    assert any("full at once" in text for text in said)


def test_what_auto_is_content_with() -> None:
    problem = dataclasses.replace(arm_problem(), collision="auto", auto_impulse_pct=0.5, auto_zmp_mm=2.0)
    for impulse, zmp, good in ((0.4, None, True), (-0.6, 0.0, False), (0.1, 1.9, True), (0.1, 2.1, False)):
        assert good_enough(problem, ModelError(impulse_pct=impulse, zmp_mm=zmp)) is good


# ---------------------------------------------------------------- words, files and meshes
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"collision": "dynamics"}, "unknown collision 'dynamics'.*full, auto"),
        ({"freezes": 2}, "freezes are for collision=\"sdc\"; with 'full' leave them out"),
        ({"collision": "sdc", "freezes": -1}, "freezes"),
        ({"collision": "sdc", "freezes": 1.5}, "freezes"),
        ({"collision": "sdc", "freezes": 65}, "freezes"),
        ({"auto_impulse_pct": 0.0}, "auto_impulse_pct must be a number > 0"),
        ({"auto_zmp_mm": np.nan}, "auto_zmp_mm"),
    ],
)
def test_bad_models_are_named(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        dataclasses.replace(arm_problem(), **changes)


def test_one_word_list() -> None:
    """A name means the same in a plan, in `impactopt collide` and in a sweep."""
    assert set(FROZEN) <= set(COLLISIONS)
    with pytest.raises(InputError, match="did you mean 'sdc-paper'"):
        frozen_model("sdc paper")
    alone = CliRunner().invoke(app, ["collide", "--help"]).output
    assert all(name in alone for name in (*FROZEN, "full"))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["virtual-mass", "sdc", "full"])
def test_a_model_that_is_far_off_is_told(model: str) -> None:
    """In a shove of a quarter of a second the arm moves far from where the model is frozen."""
    problem = load_problem("arm7")
    soft, long = SpringDamper(stiffness=300.0, damping=5.0), (0.0, 0.3)
    found = solve(
        dataclasses.replace(
            problem, law=soft, target=FreeMass(mass=2.0), collision=model, contact_duration=long
        )
    )
    assert found.status is Status.SOLVED
    simulated = found.validate().impulse
    off = 100 * (found.impulse / simulated - 1)
    assert (abs(off) > 5) == (model != "full")
    told = f"{model!r} is off by {off:+.2g} % against full dynamics" if model != "full" else ""
    assert told in found.summary().get("caution", "")
    assert bool(found.caution) == (model != "full")


@pytest.mark.slow
def test_a_contact_that_does_not_end_by_the_papers_model_is_the_reason() -> None:
    """Its arm has no torque that takes it back from a door; the solver searched for minutes."""
    door = dataclasses.replace(
        load_problem("arm7"),
        law=SpringDamper(stiffness=6e3, damping=800.0),
        target=FreeMass(mass=50.0),
        contact_duration=(0.01, 0.1),
        objectives=(Impulse(),),
    )
    with pytest.warns(NotSolvedWarning, match="By the collision model 'sdc-paper' it has not ended"):
        found = solve(dataclasses.replace(door, collision="sdc-paper"))
    assert found.status is Status.INFEASIBLE
    assert 'plan with collision.model = "full"' in found.result.message
    assert solve(door).status is Status.SOLVED


@pytest.mark.slow
def test_a_file_says_it_and_a_result_too() -> None:
    runner, extra = CliRunner(), ["--json", "-q", "--starts", "1"]
    given = ["--set", 'collision.model="sdc"', "--set", "collision.freezes=2"]
    done = runner.invoke(app, ["strike", "arm_planar", *given, *extra])
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert (summary["collision_model"], summary["freezes"]) == ("sdc", 2)
    assert 0 < abs(summary["model_error_pct"]) < 0.5
    shown = runner.invoke(app, ["strike", "arm_planar", *given, "-q", "--starts", "1"])
    text = " ".join(shown.stdout.replace("│", " ").split())
    assert "model of the collision sdc, 2 freezes on the way" in text and "model error, impulse" in text


def test_segments_begin_with_elements() -> None:
    problem = dataclasses.replace(arm_problem(), collision="sdc", freezes=5)
    shares = guessed_shares(problem)
    assert sum(shares) == pytest.approx(1) and min(shares) > 0.2
    ends = [np.cumsum(lengths) for lengths in contact_elements(problem, shares)]
    assert all(phase[-1] == pytest.approx(1) for phase in ends)
    for k in range(1, 5):
        phase, place = place_of(k / 5, shares)
        near = [*ends[phase], 0.0]
        assert min(abs(place - end) for end in near) * shares[phase] < 0.1 / 5 + 1e-9
    # a boundary of segments that is next to a phase's end gives way to it
    lengths = contact_elements(problem, (0.399, 0.601))
    assert min(h for phase in lengths for h in phase) > 0.02


@pytest.mark.parametrize("mass", [3.6, 3.8])
def test_a_mass_is_not_called_infeasible_between_two_that_are_solved(mass: float) -> None:
    problem = dataclasses.replace(arm_problem(), collision="sdc", target=FreeMass(mass=mass))
    # 3.4 and 4 kg were solved, and the constraints of these were met to 5e-5 on the way to a point where
    # their violation, of 1e-2, is stationary
    assert solve(problem).status is Status.SOLVED
