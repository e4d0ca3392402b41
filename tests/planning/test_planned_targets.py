"""Plans for every target and law: a mass on a table, whose blows have closed forms and are integrated here.

Its servo does nothing (no gains), so that from contact on it is a point mass; the collision models, which
step from event to event, are the independent integration.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import arm_problem, transcribed
from support.small_robots import arm, table

from impactopt import (
    SDC,
    Board,
    ContactLaw,
    CustomLaw,
    FixedBase,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    ImpactProblem,
    InputError,
    KelvinVoigt,
    Nail,
    PeakForce,
    Penetration,
    Phase,
    Plan,
    RigidWall,
    Scenario,
    Slide,
    SpringDamper,
    Status,
    Target,
    TargetSpeed,
)
from impactopt.collision import Collision
from impactopt.contact import power
from impactopt.kinematics.splines import Radau
from impactopt.solvers.elimination.condense import Condenser, find_eliminations
from impactopt.solvers.elimination.kernels import Kernels
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import Determined, check_program
from impactopt.transcription.contact_conditions import CLEARANCE, CLEARANCE_RATE
from impactopt.transcription.contact_guess import speed_that_leaves
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.mesh import contact_mesh

Array = NDArray[np.float64]
MASS = 2.0  # [kg] of the hammer
DAMPED = KelvinVoigt(stiffness=1e4, damping=300.0)
NAIL = Nail(mass=0.1, resistance=300.0, hardening=1e4, depth=0.005)
BOARD = Board(mass=0.3, stiffness=1e5, breaking_force=400.0, damping=5.0)
FINE = ((0.05, 0.15, 0.2, 0.3, 0.3), (0.3, 0.3, 0.4))


def problem(law: ContactLaw, target: Target, **options: Any) -> ImpactProblem:
    """As fast as may be against a target 0.3 m ahead: the swing's end is all there is to choose."""
    given: dict[str, Any] = {
        "robot": table(MASS),
        "striker": "tip",
        "start": np.zeros(2),
        "stance": FixedBase(),
        "point": np.array([0.3, 0.0, 0.0]),
        "normal": [1.0, 0.0, 0.0],
        "swing": Phase(duration=0.5, intervals=8),
        "follow": Phase(duration=0.6, intervals=8),
        "contact_duration": (1e-4, 0.05),
        "collision_elements": FINE,
    }
    return ImpactProblem(law=law, target=target, **{**given, **options})


def solved(p: ImpactProblem) -> Plan:
    transcription = transcribed(p)
    result = solve_ipopt(transcription.program, first_iterate(transcription))
    assert result.status is Status.SOLVED, result.message
    return transcription.decode(result.x)


def integrated(plan: Plan) -> Collision:
    """What a collision model says of a point mass at the plan's speed."""
    p = plan.problem
    given: dict[str, Any] = {"robot": p.robot, "striker": "tip", "normal": p.normal, "stance": FixedBase()}
    sdc = SDC(**given, law=p.law, target=p.target)
    return sdc.collide(np.array([0.3, 0.0]), np.array([plan.hand_speed, 0.0]), np.zeros(2))


def weights(plan: Plan) -> Array:
    """[s] of the collocation points after contact in an integral over the contact, by Radau's quadrature."""
    p, mesh = plan.problem, contact_mesh(plan.problem)
    last = Radau.of_stages(p.collision_stages).a[-1]
    count = len(last)
    time = np.concatenate([[0.0], plan.collision.time[1:]])
    ends = time[::count]
    assert len(mesh) == len(time) - 1
    return np.concatenate([length * last for length in np.diff(ends)])


# ---- closed forms: a point mass against a wall


@pytest.mark.parametrize("damping", [0.0, 100.0, 300.0])
def test_a_wall_gives_back_what_the_damper_leaves(damping: float) -> None:
    """zeta = d / (2 sqrt(k m)): e = exp(-2 zeta acos(zeta) / sqrt(1 - zeta^2)), a force of zero ends it."""
    k = 1e5
    plan = solved(problem(KelvinVoigt(stiffness=k, damping=damping), RigidWall()))
    zeta = damping / (2 * np.sqrt(k * MASS))
    e = np.exp(-2 * zeta * np.arccos(zeta) / np.sqrt(1 - zeta**2))
    assert plan.impulse == pytest.approx(MASS * plan.hand_speed * (1 + e), rel=2e-5)
    w = np.sqrt(k / MASS * (1 - zeta**2))
    separation = 2 * np.arccos(zeta) / w if damping else np.pi / w
    assert plan.collision.time[-1] == pytest.approx(separation, rel=2e-4)
    assert plan.collision.force[0] == pytest.approx(damping * plan.hand_speed)
    assert plan.collision.force[-1] == 0.0
    assert (plan.collision.target_speed == 0.0).all()
    assert plan.collision.outcome == {}


def test_a_free_mass_takes_what_two_masses_exchange() -> None:
    m = 1.5
    plan = solved(problem(HuntCrossley(stiffness=3e6, dissipation=0.0), FreeMass(mass=m)))
    exact = 2 * MASS * m / (MASS + m) * plan.hand_speed
    assert plan.impulse == pytest.approx(exact, rel=1e-4)
    assert plan.collision.outcome == {"speed_m_s": pytest.approx(exact / m, rel=1e-4)}
    assert plan.collision.target_speed[-1] == pytest.approx(exact / m, rel=1e-4)


# ---- every law and target against the collision models


@pytest.mark.parametrize(
    ("law", "target", "rel"),
    [
        (SpringDamper(stiffness=1e5, damping=200.0), FreeMass(mass=1.0), 1e-4),
        (HuntCrossley(stiffness=3e6, dissipation=0.1), FreeMass(mass=1.0), 3e-4),
        (HertzDamped(stiffness=3e6, damping=1000.0), FreeMass(mass=1.0), 1e-3),
        (HertzDamped(stiffness=3e6, damping=0.0), RigidWall(), 1e-3),
        (KelvinVoigt(stiffness=1e5, damping=100.0), NAIL, 1e-3),
        (HuntCrossley(stiffness=5e6, dissipation=0.5), NAIL, 1e-3),
        (SpringDamper(stiffness=1e5, damping=100.0), BOARD, 1e-4),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, (ContactLaw, Target)) else "",
)
def test_the_impulse_is_that_of_the_collision_model(law: ContactLaw, target: Target, rel: float) -> None:
    plan = solved(problem(law, target))
    exact = integrated(plan)
    assert plan.impulse == pytest.approx(exact.impulse, rel=rel)
    assert plan.collision.time[-1] == pytest.approx(exact.duration, rel=5e-3)
    # the integral of the force over the contact
    assert weights(plan) @ plan.collision.force[1:] == pytest.approx(plan.impulse, rel=1e-6)
    assert (plan.collision.force >= -1e-6).all()


@pytest.mark.parametrize("resistance", [150.0, 400.0])
def test_a_nail_goes_as_deep_as_its_energy_lasts(resistance: float) -> None:
    """What force and speed of its head give it is the work against the wood, R z + hardening z^2 / 2."""
    nail = dataclasses.replace(NAIL, resistance=resistance)
    plan = solved(problem(KelvinVoigt(stiffness=1e5, damping=100.0), nail))
    hit, depth = plan.collision, plan.collision.outcome["depth_m"]
    given = weights(plan) @ (hit.force * hit.target_speed)[1:]
    start = resistance + nail.hardening * nail.depth
    assert start * depth + nail.hardening * depth**2 / 2 == pytest.approx(given, rel=5e-3)
    assert depth == pytest.approx(integrated(plan).target_result["depth"], rel=1e-2)
    assert depth > 5e-3
    assert (hit.target_speed >= 0).all()


@pytest.mark.parametrize(("damping", "at_once"), [(100.0, False), (400.0, True)])
def test_a_nail_starts_where_the_force_is_what_the_wood_holds(damping: float, at_once: bool) -> None:
    """A damper's first force may be more than that: then it starts with the first touch."""
    plan = solved(problem(KelvinVoigt(stiffness=1e5, damping=damping), NAIL))
    hit, held = plan.collision, NAIL.resistance + NAIL.hardening * NAIL.depth
    pressed = plan.problem.collision_stages
    assert (hit.force[0] > held) == at_once
    assert (hit.target_speed[: pressed + 1] == 0).all()
    if at_once:
        assert hit.time[pressed] < 0.2 * plan.problem.contact_duration[0]
    else:
        assert hit.force[pressed] == pytest.approx(held, rel=1e-3)
        assert (hit.force[:pressed] < held).all()
    exact = integrated(plan)
    assert plan.impulse == pytest.approx(exact.impulse, rel=1e-3)
    assert hit.outcome["depth_m"] == pytest.approx(exact.target_result["depth"], rel=2e-3)
    standing = hit.time[1:] > plan.compression * (1 + 1e-9)
    assert np.abs(hit.target_speed[1:][standing]).max() < 1e-9
    assert (hit.force[1:][standing] < held + NAIL.hardening * hit.outcome["depth_m"]).all()


@pytest.mark.parametrize("target", [NAIL, RigidWall(), FreeMass(mass=1.0)], ids=lambda t: type(t).__name__)
def test_what_stays_is_not_touched_again(target: Target) -> None:
    """The hammer keeps off it as long as it follows through, and need not keep off what has gone."""
    p = problem(KelvinVoigt(stiffness=1e5, damping=100.0), target)
    transcription = transcribed(p)
    program = transcription.program
    rows = [i for i in range(program.m) if program.constraint_name(i).startswith("no touch after contact")]
    assert bool(rows) == target.stays
    if not target.stays:
        return
    result = solve_ipopt(program, first_iterate(transcription))
    plan = transcription.decode(result.x)
    after = np.linspace(0.0, plan.follow.duration, 50)
    x = plan.follow.sample(after)[0][:, 0]
    assert (x[1:] <= x[0] - np.minimum(CLEARANCE, CLEARANCE_RATE * after[1:]) + 1e-3).all()


def test_a_board_breaks_where_its_spring_has_the_breaking_force() -> None:
    """And not before; afterwards it is a free mass, whose momentum is all it gets."""
    plan = solved(problem(SpringDamper(stiffness=1e5, damping=100.0), BOARD))
    hit, of = plan.collision, weights(plan)
    assert hit.outcome == {"broken": 1.0}
    third = sum(len(lengths) for lengths in FINE[:1]) * 2 * plan.problem.collision_stages
    deflection = of[:third] @ hit.target_speed[1 : third + 1]
    assert deflection == pytest.approx(BOARD.breaking_force / BOARD.stiffness, rel=1e-6)
    gained = BOARD.mass * (hit.target_speed[-1] - hit.target_speed[third])
    assert gained == pytest.approx(of[third:] @ hit.force[third + 1 :], rel=1e-6)
    assert plan.compression + plan.restitution == pytest.approx(hit.time[-1])
    assert hit.time[third] < plan.compression


# ---- the program


@pytest.mark.parametrize("target", [NAIL, BOARD, RigidWall()], ids=lambda t: type(t).__name__)
def test_programs_are_sound(target: Target) -> None:
    """On the small arm: names, derivatives against differences, all variables used."""
    changes: dict[str, Any] = {"target": target}
    if isinstance(target, Nail):
        changes = {"target": dataclasses.replace(target, resistance=40.0), "law": DAMPED}
    p = dataclasses.replace(arm_problem(), **changes, scenarios=(Scenario(name="hard", stiffness=2.0),))
    program = (t := transcribed(p)).program
    x = first_iterate(t) + 1e-4 * np.random.default_rng(0).standard_normal(t.layout.n)
    x = np.clip(x, program.x_lower, program.x_upper)
    check_program(program, x)
    names = [program.constraint_name(i) for i in range(program.m)]
    assert len(set(names)) == program.m
    used = np.asarray(abs(program.jacobian(x)).sum(axis=0)).ravel() + np.abs(program.gradient(x))
    fixed = program.x_lower == program.x_upper  # the force at separation
    assert [program.variable_name(int(j)) for j in np.flatnonzero((used == 0) & ~fixed)] == []
    rng, h = np.random.default_rng(1), 1e-7
    y, d = rng.standard_normal(program.m), rng.standard_normal(program.n)
    jacobian, hessian = program.jacobian(x), program.hessian(x, 0.7, y)
    of_rows = (program.constraints(x + h * d) - program.constraints(x - h * d)) / (2 * h)
    assert (np.abs(jacobian @ d - of_rows) <= 1e-5 * (abs(jacobian) @ np.abs(d)) + 1e-5).all()
    slopes = [0.7 * program.gradient(z) + program.jacobian(z).T @ y for z in (x + h * d, x - h * d)]
    of_slope = (slopes[0] - slopes[1]) / (2 * h)
    size = abs(hessian) @ np.abs(d)
    assert (np.abs(hessian @ d - of_slope) <= 1e-4 * size + 1e-5 * size.max()).all()


@pytest.mark.parametrize("target", [NAIL, BOARD], ids=lambda t: type(t).__name__)
def test_what_determines_no_variables_of_its_own_is_where_and_when(target: Target) -> None:
    """Ways as one are eliminated by rows of their own, and not by the separation: that leaves bad numbers."""
    p = dataclasses.replace(arm_problem(), target=target, law=DAMPED)
    program = (t := transcribed(p)).program
    x = first_iterate(t)
    jacobian = program.jacobian(x)
    equal = program.g_lower == program.g_upper
    wanted = [Determined(*w) for w in program.determined if len(w[1])]
    condenser = Condenser(
        jacobian,
        program.hessian(x, 1.0, np.zeros(program.m)),
        find_eliminations(jacobian, equal, wanted),
        equal,
        np.zeros(program.n, dtype=bool),
        Kernels(),
    )
    left = {program.constraint_name(int(i)).split(",")[0] for i in condenser.remaining[condenser.equal]}
    turn = {"end of compression"} if target.turns else set()
    assert left == {"hit point", "separation", *target.guards, *turn}


def test_plans_of_an_arm_drive_nails_and_break_boards() -> None:
    """Its servo gives way: a stiff one goes on into the target, and there is no separation."""
    robot = arm(kp=300.0, kd=10.0)
    for target in (
        Nail(mass=0.1, resistance=150.0, hardening=1e3),
        Board(mass=0.3, stiffness=2e4, breaking_force=50.0),
    ):
        law = KelvinVoigt(stiffness=5e4, damping=100.0)
        plan = solved(dataclasses.replace(arm_problem(), robot=robot, law=law, target=target))
        assert plan.impulse > 0.5
        assert next(iter(plan.collision.outcome.values())) > 3e-3
        assert contact_mesh(plan.problem)[-1].name == f"{target.phases[-1]}, 100 %"


# ---- what is refused


class Ratchet(FreeMass):
    """A target with switches that says nothing of plans."""

    def switches(self, state: Any, force: Any, parameters: Any = None) -> list[Any]:
        return [state[0]]


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"target": Ratchet(mass=1.0)}, ["Ratchet has switches", "`smooth`"]),
        ({"target": 5.0}, ["target must be a Target", "5.0"]),
        ({"law": "spring"}, ["law must be a ContactLaw"]),
        ({"target": NAIL}, ["a Nail needs a law", "KelvinVoigt", "not SpringDamper"]),
        (
            {"target": NAIL, "law": DAMPED, "objectives": (Penetration(),)},
            ["Penetration has no peak", "take PeakForce"],
        ),
        ({"target": NAIL, "collision": "rigid"}, ["FreeMass and RigidWall only", "Nail"]),
        (
            {"target": RigidWall(), "scenarios": (Scenario(name="heavy", mass=2.0),)},
            ["scenario 'heavy'", "RigidWall has no mass", "leave it out"],
        ),
        (
            {
                "law": HuntCrossley(stiffness=1e6, dissipation=0.1),
                "scenarios": (Scenario(name="dull", damping=2.0),),
            },
            ["scenario 'dull'", "HuntCrossley has no damping"],
        ),
    ],
)
def test_what_cannot_be_planned_is_refused(changes: dict[str, Any], parts: list[str]) -> None:
    given = problem(SpringDamper(stiffness=1e4, damping=0.0), FreeMass(mass=1.0))
    with pytest.raises(InputError) as caught:
        dataclasses.replace(given, **changes)
    assert [part for part in parts if part not in str(caught.value)] == []


def test_scenarios_have_their_own_numbers() -> None:
    law, target = SpringDamper(stiffness=1e4, damping=30.0), NAIL
    of_law, of_target = Scenario(name="all", mass=2.0, stiffness=3.0, damping=0.5).numbers(law, target)
    assert of_law == {"stiffness": 3e4, "damping": 15.0}
    assert of_target == {**target.parameters, "mass": 0.2}


def test_a_rigid_impact_on_a_wall_stops_or_turns_the_hand() -> None:
    """Newton's restitution: the mass comes back with e of its speed."""
    rigid: dict[str, Any] = {"collision": "rigid", "coefficient_of_restitution": 0.25}
    plan = solved(problem(SpringDamper(stiffness=1e4, damping=0.0), RigidWall(), **rigid))
    assert plan.impulse == pytest.approx(1.25 * MASS * plan.hand_speed, rel=1e-6)
    assert plan.collision.outcome == {} and plan.collision.peak_force == np.inf


# ---- laws of a user's own


class Rubber(ContactLaw):
    """A class with a power as one writes it at first."""

    parameters: ClassVar[dict[str, float]] = {}

    def branch(self, penetration: Any, rate: Any, compressing: bool, parameters: Any = None) -> Any:
        return 3e6 * penetration**1.5 * (1 + 0.15 * rate)


class Rounded(Rubber):
    """The same, as it is to be written."""

    def branch(self, penetration: Any, rate: Any, compressing: bool, parameters: Any = None) -> Any:
        return 3e6 * power(penetration, 1.5) * (1 + 0.15 * rate)

    def separation(self, penetration: Any, rate: Any, parameters: Any = None) -> Any:
        return 3e6 * penetration


def test_a_power_as_a_user_writes_it_is_planned_with() -> None:
    """Hunt and Crossley's law as a formula: it was no number where the search passes through zero."""
    target = FreeMass(mass=1.0)
    known = solved(problem(HuntCrossley(stiffness=3e6, dissipation=0.1), target))
    formula = CustomLaw(compression=lambda x, rate, k, d: k * x**1.5 * (1 + 1.5 * d * rate), k=3e6, d=0.1)
    for law in (formula, Rounded()):
        plan = solved(problem(law, target))
        assert plan.impulse == pytest.approx(known.impulse, rel=1e-4)
        assert plan.collision.force.max() == pytest.approx(known.collision.force.max(), rel=1e-3)


def test_a_class_that_is_no_number_below_zero_is_refused() -> None:
    with pytest.raises(InputError, match=r"the law Rubber has no finite .* 0 mm.*impactopt\.contact\.power"):
        problem(Rubber(), FreeMass(mass=1.0))


# ---- targets that move before contact


def ball(before: float, **options: Any) -> ImpactProblem:
    law = HuntCrossley(stiffness=3e6, dissipation=0.1)
    return problem(law, FreeMass(mass=0.5, initial_velocity=before), **options)


@pytest.mark.parametrize("before", [-4.0, 0.3])
def test_a_target_that_comes_or_goes_is_hit_as_the_collision_models_say(before: float) -> None:
    plan = solved(ball(before))
    assert plan.impulse == pytest.approx(integrated(plan).impulse, rel=5e-4)
    gained = plan.collision.outcome["speed_m_s"] - before
    assert 0.5 * gained == pytest.approx(plan.impulse, rel=1e-6)
    assert plan.collision.target_speed[0] == before


@pytest.mark.parametrize("collision", ["rigid", "virtual-mass"])
def test_an_impact_without_duration_knows_how_fast_the_target_comes(collision: str) -> None:
    """Two masses, closed form: (1 + e) mu times the difference of their speeds."""
    p = problem(
        SpringDamper(stiffness=1e5, damping=0.0),
        FreeMass(mass=0.5, initial_velocity=-4.0),
        collision=collision,
        coefficient_of_restitution=0.5 if collision == "rigid" else 0.0,
    )
    plan = solved(p)
    e = 0.5 if collision == "rigid" else 1.0
    mu = MASS * 0.5 / (MASS + 0.5)
    assert plan.impulse == pytest.approx((1 + e) * mu * (plan.hand_speed + 4.0), rel=1e-6)
    assert plan.collision.outcome["speed_m_s"] == pytest.approx(plan.impulse / 0.5 - 4.0)


def test_the_striker_keeps_behind_a_target_that_goes_before_it() -> None:
    """Its plane is where it is then: 0.3 m/s for 0.5 s are half of the way."""
    plan = solved(ball(0.3))
    time = np.linspace(0.0, plan.contact_start - 1e-3, 200)
    hand = plan.independent(0, time)[0][:, 0]
    surface = 0.3 + plan.travel(time)
    assert surface[0] == pytest.approx(0.15)
    assert (hand <= surface + 1e-6).all()
    assert hand.max() < 0.3


def test_what_comes_is_caught_if_its_speed_after_contact_is_to_be_none() -> None:
    """The impulse is the mass's momentum, whatever the hand does, and the hand gives way for it."""
    p = ball(-1.0, objectives=(PeakForce(weight=-0.01),))
    p = dataclasses.replace(p, terms=(*p.terms, TargetSpeed(least=-1e-3, most=1e-3)))
    plan = solved(p)
    assert plan.impulse == pytest.approx(0.5, abs=1e-3)
    assert plan.hand_speed < 0


def test_the_striker_gives_way_to_a_target_that_comes_on_after_contact() -> None:
    """At 0.2 m/s for 3 s: a hand that stops at once would be hit again."""
    p = ball(-1.0, objectives=(PeakForce(weight=-0.01),), follow=Phase(duration=3.0, intervals=8))
    plan = solved(dataclasses.replace(p, terms=(*p.terms, TargetSpeed(least=-0.3, most=-0.2))))
    after = np.linspace(0.0, plan.follow.duration, 50)
    x = plan.follow.sample(after)[0][:, 0]
    surface = x[0] + plan.collision.outcome["speed_m_s"] * after
    assert (x[1:] <= (surface - np.minimum(CLEARANCE, CLEARANCE_RATE * after))[1:] + 1e-3).all()


def test_lifted_variables_are_found_beside_rows_on_demand() -> None:
    """Which have a block of a name that is there already."""
    p = ball(-1.0)
    t = transcribed(dataclasses.replace(p, terms=(*p.terms, TargetSpeed(least=-0.3, most=-0.2), Slide())))
    x = t.with_lifted(first_iterate(t))
    rows = t.program.constraints(x)
    lifted = [
        i
        for i in range(t.program.m)
        if t.program.constraint_name(i).startswith(("target's way", "target left"))
    ]
    assert len(lifted) == 2 and np.abs(rows[lifted]).max() < 1e-9


def test_a_catch_starts_from_a_hand_that_goes_back() -> None:
    """Closed form: an undamped spring leaves the target at rest where 2 M u = (M - m) times its speed."""
    law, coming = SpringDamper(stiffness=1e4, damping=0.0), FreeMass(mass=0.5, initial_velocity=-5.0)
    for given in (-3.0, 1.0):
        speed = speed_that_leaves(law, coming, MASS, given, -0.01, 0.01)
        assert speed == pytest.approx((MASS - 0.5) * -5.0 / (2 * MASS), abs=0.05)
    assert speed_that_leaves(law, coming, MASS, 1.0, -np.inf, np.inf) == 1.0


def test_a_bound_on_the_targets_speed_is_kept() -> None:
    free = solved(ball(-2.0)).collision.outcome["speed_m_s"]
    p = ball(-2.0)
    slower = solved(dataclasses.replace(p, terms=(*p.terms, TargetSpeed(least=-np.inf, most=0.8 * free))))
    assert slower.collision.outcome["speed_m_s"] <= 0.8 * free + 1e-6
    with pytest.raises(InputError, match="swap"):
        TargetSpeed(least=1.0, most=0.0)
