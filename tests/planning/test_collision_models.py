"""One name, one prediction: models of the collision inside plans, and the same models on their own."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import arm_problem, biped_problem, struck

from impactopt import coasting_reference, load_problem, optimize_strike
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.rungs import frozen_model
from impactopt.contact import (
    FreeMass,
    HertzDamped,
    HuntCrossley,
    KelvinVoigt,
    RigidWall,
    SpringDamper,
)
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.sqp import solve_sqp
from impactopt.transcription.mesh import contact_elements
from impactopt.transcription.planned_strike import PlannedStrike
from impactopt.transcription.start import strike_iterate
from impactopt.transcription.strike import StrikeTranscription

pytestmark = [
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
]

Array = NDArray[np.float64]
# fine enough that collocation does not count: what is left is the model
FINE = ((0.02, 0.06, 0.12, 0.2, 0.3, 0.3), (0.25, 0.25, 0.25, 0.25))
IMPULSE, ZMP = 1e-4, 0.1  # relative; [mm]


def planned(problem: ImpactProblem) -> tuple[StrikeTranscription, PlannedStrike]:
    """The strike of a problem, and its program."""
    t = struck(problem)
    result = solve_sqp(t.program, strike_iterate(t))
    assert result.status.usable
    shares = t.hit.drifted(result.x)
    if shares is not None:
        t = StrikeTranscription(
            problem, t.coordinates, t.functions, contact_elements(problem, shares), shares
        )
        result = solve_sqp(t.program, strike_iterate(t))
        assert result.status.usable and t.hit.drifted(result.x) is None
    return t, t.decode(result.x)


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
CASES += [
    ("spring-damper", model, n)
    for model, n in (("virtual-mass", 0), ("sdc-paper", 0), ("sdc", 1), ("sdc", 4))
]
CASES += [("Kelvin-Voigt", "sdc-paper", 0), ("Hunt-Crossley", "sdc", 3)]


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


def test_weight_and_legs_by_the_papers_terms() -> None:
    """The small biped's ZMP: its wrenches have the weight that the model leaves out."""
    problem = dataclasses.replace(biped_problem(), collision="sdc-paper", collision_elements=FINE)
    _, strike = planned(problem)
    found = alone(strike, step=1e-4)
    assert strike.impulse == pytest.approx(found.impulse, rel=IMPULSE)
    assert zmp_apart(strike, found).max() < ZMP


def test_a_humanoids_zmp() -> None:
    """TALOS, frozen at contact: a leg's servo follows a reference that bends."""
    problem = dataclasses.replace(load_problem("punch"), collision="sdc", collision_elements=FINE)
    solution = optimize_strike(problem)
    assert solution.status.usable
    found = alone(solution.strike, step=1e-4)
    assert solution.impulse == pytest.approx(found.impulse, rel=IMPULSE)
    assert zmp_apart(solution.strike, found).max() < ZMP
    assert solution.model_error is not None and abs(solution.model_error.impulse_pct) > 0.5
