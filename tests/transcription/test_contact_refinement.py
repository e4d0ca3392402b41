"""What a planned contact is off by for its elements, and the finer ones that it gets.

A mass with a servo pushes a heavier one, against SciPy's integration of the same equation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.small_plans import BODILESS, Planned, changed, transcribed
from support.small_robots import table

from impactopt import FixedBase, FreeMass, ImpactProblem, Phase, Scenario, Solution, SpringDamper, Status
from impactopt.planning import solution as solutions
from impactopt.planning.solve import solve
from impactopt.solvers.ipm import solve_ipm
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_refinement import (
    ContactError,
    contact_error,
    refined_elements,
    same_places,
)
from impactopt.transcription.initial_guess import first_iterate, warm_start
from impactopt.transcription.mesh import Elements, contact_elements, contact_mesh, halved
from impactopt.transcription.transcription import Transcription

MASS, KP, KD = 2.0, 200.0, 10.0  # [kg], [N/m], [N s/m] of the hammer and its servo
COARSE = ((1.0,), (1.0,))


def problem(**options: Any) -> ImpactProblem:
    """A push: the servo is slow beside the contact, and goes on while that rings.

    The table's two masses are in one place, so its first one goes where the striking one does.
    """
    given: dict[str, Any] = {
        "robot": table(MASS, kp=KP, kd=KD),
        "striker": "tip",
        "start": np.zeros(2),
        "stance": FixedBase(),
        "point": np.array([0.3, 0.0, 0.0]),
        "normal": [1.0, 0.0, 0.0],
        "law": SpringDamper(stiffness=3e3, damping=20.0),
        "target": FreeMass(mass=6.0),
        "swing": Phase(duration=(0.5, 0.5), intervals=8),
        "follow": Phase(duration=(0.9, 0.9), intervals=8),
        "contact_duration": (1e-3, 0.3),
        "collision_elements": COARSE,
        "collision_stages": 2,
        "terms": BODILESS,
    }
    return ImpactProblem(**{**given, **options})


def true_impulse(solution: Solution, law: Any = None, target: Any = None) -> float:
    """[N s] from contact until the force is zero, with the law's switch where the masses stop to approach."""
    p, speed = solution.problem, solution.plan.hand_speed
    law, target = law or p.law, target or p.target

    def force(y: Any) -> float:
        return float(law.force(y[0] - y[2], y[1] - y[3]))

    def flow(t: float, y: Any) -> list[float]:
        f = force(y)
        servo = KP * (speed * t - y[0]) + KD * (speed - y[1])
        return [y[1], (servo - f) / MASS, y[3], f / target.mass]

    def apart(t: float, y: Any) -> float:
        return float(y[0] - y[2]) if t > 1e-4 else 1.0

    apart.terminal = True  # type: ignore[attr-defined]
    start = [0.0, speed, 0.0, 0.0]
    found = solve_ivp(flow, (0.0, 2.0), start, events=apart, rtol=1e-9, atol=1e-11, max_step=1e-3)
    assert found.status == 1
    return float(target.mass * found.y[3, -1])


@pytest.fixture(scope="module")
def transcription() -> Transcription:
    return transcribed(problem())


@pytest.fixture
def functions(transcription: Transcription, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solutions, "block_functions", lambda *_: transcription.functions)


def off(solution: Solution) -> float:
    """True error of the planned impulse [%]."""
    return 100 * (true_impulse(solution) / solution.impulse - 1)


def test_the_estimate_is_the_true_error(functions: None) -> None:
    for elements in (COARSE, halved(COARSE)):
        solution = solve(problem(collision_elements=elements), refine=False)
        assert solution.status.usable and solution.elements == ()
        assert solution.contact_error_pct == pytest.approx(off(solution), rel=0.3, abs=0.02)
        if elements == COARSE:
            assert abs(off(solution)) > 1.0
            assert solution.status is Status.ACCEPTABLE  # not refined, it says that it is not what it says
            assert solution.summary()["caution"] in solution.result.message


@pytest.mark.slow
def test_a_coarse_contact_gets_finer_elements_until_it_is_right(functions: None) -> None:
    solution = solve(problem())
    assert solution.status is Status.SOLVED
    assert abs(off(solution)) < 0.6  # the estimate is a little low
    assert solution.contact_error_pct == pytest.approx(off(solution), abs=0.1)
    assert [round(sum(phase), 9) for phase in solution.elements] == [1.0, 1.0]
    assert solution.summary()["collision_elements"] == solution.contact_elements > [1, 1]
    assert solution.summary()["collision_error_pct"] == solution.contact_error_pct
    assert len(solution.attempts) > 1 and "contact elements" in solution.attempts[-1].start
    # a neighbour starts with the same elements
    near = solve(problem(target=FreeMass(mass=6.1)), start=solution)
    assert near.status is Status.SOLVED and near.elements and abs(off(near)) < 0.6


def test_a_contact_that_is_right_is_left_alone(functions: None) -> None:
    solution = solve(problem(collision_elements=((0.25,) * 4, (0.25,) * 4)))
    assert solution.elements == () and abs(off(solution)) < 0.6
    assert solution.contact_elements == [4, 4] and len(solution.attempts) == 1


def test_each_scenario_counts(transcription: Transcription) -> None:
    stiff = Scenario(name="stiff", stiffness=3e4)
    t = changed(transcription, scenarios=(stiff,), collision_elements=halved(COARSE))
    alone = changed(transcription, collision_elements=halved(COARSE))
    x = solve_ipm(t.program, first_iterate(t)).x
    both, one = (
        contact_error(t, x),
        contact_error(alone, solve_ipm(alone.program, first_iterate(alone)).x),
    )
    assert both is not None and one is not None
    assert abs(both.pct) >= abs(one.pct) * 0.9


@pytest.mark.parametrize("factor", [0.95, 1.05, 2.0])
def test_a_contact_that_ends_at_another_time(transcription: Transcription, factor: float) -> None:
    """It ends where the force is zero, whatever a plan says; the impulse that was planned is right."""
    t = changed(transcription, collision_elements=((0.25,) * 4, (0.25,) * 4), collision_stages=3)
    x = solve_ipm(t.program, first_iterate(t)).x
    assert isinstance(t.expected, Collision)
    last = t.expected.T[-1].index(0)
    x[last] *= factor
    error = contact_error(t, x)
    assert error is not None and not error.missed
    assert abs(error.pct) < 0.2


def test_an_impact_in_no_time_has_no_elements(transcription: Transcription) -> None:
    t = changed(transcription, collision="rigid")
    assert contact_error(t, np.zeros(t.program.n)) is None
    assert refined_elements(None, t.hit.elements) is None


def told(errors: tuple[tuple[float, ...], ...], **options: Any) -> ContactError:
    total = float(sum(map(sum, errors)))
    return ContactError(**{"pct": total, "coarse": total, "of_elements": errors, "missed": False, **options})


def test_elements_are_cut_where_their_errors_are() -> None:
    elements: Elements = ((0.2, 0.8), (1.0,))
    assert refined_elements(told(((0.0, 0.1), (0.2,))), elements) is None
    found = refined_elements(told(((0.0, 0.1), (4.0,))), elements)
    assert found is not None and found[0] == elements[0] and len(found[1]) > 1
    more = refined_elements(told(((0.0, 0.1), (400.0,))), elements)
    assert more is not None and len(more[1]) > len(found[1])
    # what is the law's, and not the elements', is not cut
    assert refined_elements(told(((0.0, 0.1), (0.2,)), pct=3.0), elements) is None
    # an event that is missed may be anywhere
    everywhere = refined_elements(told(((0.0, 0.0), (0.0,)), pct=np.inf, missed=True), elements)
    assert everywhere == halved(elements)
    unknown = refined_elements(told(((np.inf, np.inf), (np.inf,))), elements)
    assert unknown is not None and [sum(phase) for phase in unknown] == pytest.approx([1.0, 1.0])
    # and there is an end to it
    for _ in range(20):
        if (following := refined_elements(told(tuple((9.0,) * len(e) for e in elements)), elements)) is None:
            break
        elements = following
    assert following is None


def test_finer_elements_start_where_the_old_ones_ended(biped_plan: Planned) -> None:
    old, result = biped_plan.transcription, biped_plan.result
    new = Transcription(old.problem, old.functions, old.nodes, halved(contact_elements(old.problem)))
    x, y, z = warm_start(new, old, result.x, result.multipliers, result.bound_multipliers)
    g = new.program.constraints(x)
    assert np.maximum(new.program.g_lower - g, g - new.program.g_upper).max() < 0.2
    pairs = same_places(new.hit.stages, old.hit.stages)
    assert len(pairs) == sum(map(len, old.hit.elements))
    assert len(contact_mesh(old.problem)) == len(old.hit.stages)
    for mine, its in zip(new.hit.collisions, old.hit.collisions, strict=True):
        for name in ("u", "f", "p", "legs", "w"):
            a, b = getattr(mine, name).read(x), getattr(its, name).read(result.x)
            np.testing.assert_allclose([a[i] for i, _ in pairs], [b[k] for _, k in pairs], atol=1e-9)
    # what is not of the contact is as it was
    np.testing.assert_array_equal(new.swing.c.read(x), old.swing.c.read(result.x))
    assert np.count_nonzero(y) and np.count_nonzero(z)
    # and it does not pull
    assert isinstance(new.expected, Collision)
    assert (new.program.x_lower[new.expected.f.index(0)] == 0.0).all()


def test_a_scenario_may_be_called_like_a_phase(transcription: Transcription) -> None:
    t = changed(transcription, scenarios=(Scenario(name="swing heavier", mass=8.0),))
    x, none = first_iterate(t), (np.zeros(t.program.m), np.zeros(t.program.n))
    new = Transcription(t.problem, t.functions, elements=halved(t.hit.elements))
    found = warm_start(new, t, x, *none)[0]
    group, known = (p.layout.groups["swing heavier: contact force"] for p in (new, t))
    assert group.count > known.count and np.isfinite(group.read(found)).all()


def test_the_old_contact_is_a_warm_start(transcription: Transcription) -> None:
    t = changed(transcription, collision_elements=((0.25,) * 4, (0.25,) * 4))
    first = solve_ipm(t.program, first_iterate(t))
    new = Transcription(t.problem, t.functions, elements=halved(t.hit.elements))
    x, y, z = warm_start(new, t, first.x, first.multipliers, first.bound_multipliers)
    again = solve_ipm(new.program, x, multipliers=y, bound_multipliers=z)
    assert again.status is Status.SOLVED and again.iterations < first.iterations
    assert again.objective == pytest.approx(first.objective, rel=0.02)
