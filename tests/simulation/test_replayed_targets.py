"""Replays of every law and target: closed forms, independent integration, and plans of the small robots."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from support.small_motions import given_until, reference, scene
from support.small_plans import BODILESS, arm_problem, transcribed
from support.small_robots import arm, slider, table

from impactopt import (
    Board,
    ContactLaw,
    CustomLaw,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    InputError,
    KelvinVoigt,
    Nail,
    Perturbation,
    PerturbationRanges,
    RigidWall,
    Robot,
    SpringDamper,
    Status,
    Striker,
    Target,
    TargetBody,
)
from impactopt.bodies.clearance import Places
from impactopt.report.console import replay_table
from impactopt.simulation import (
    ControllerSettings,
    Scene,
    Simulation,
    robustness,
    scene_of,
    simulate,
    simulate_mujoco,
    simulate_pinocchio,
)
from impactopt.simulation.engines import check_steps, longest_stable_step, with_step_error
from impactopt.solvers.ipm.interior_point import solve_ipm
from impactopt.transcription.initial_guess import first_iterate

Array = NDArray[np.float64]
Engine = Callable[..., Simulation]
ENGINES = pytest.mark.parametrize("engine", [simulate_pinocchio, simulate_mujoco], ids=["held", "free"])
MASS, SPEED, PUSH = 2.0, 1.5, 0.05  # [kg], [m/s], [s] of the hammer; how long it is pushed
STEP, BLOW = 4e-5, 0.02  # [s]; how long the blow is watched
NAIL = Nail(mass=0.1, resistance=300.0, hardening=1e4, depth=0.005)
BOARD = Board(mass=0.3, stiffness=1e5, breaking_force=400.0, damping=5.0)
FINE = ((0.1, 0.2, 0.3, 0.4), (0.25, 0.25, 0.5))


def hammer(target: Target, law: ContactLaw) -> tuple[Robot, Any, Scene]:
    """A point mass that is pushed to its speed and let go hits: robot, reference, scene."""
    force = MASS * SPEED / PUSH
    torque = [[force], [force], [0.0], [0.0]]
    ref = reference([0.0, PUSH, PUSH, PUSH + 0.002 + BLOW], np.zeros(1), torque=torque, nv=1, n=1)
    point = np.array([0.5 * SPEED * PUSH + SPEED * 0.002, 0.0, 0.0])
    return slider(MASS), ref, scene(point=point, law=law, target=target)


def blow(
    engine: Engine, law: ContactLaw, target: Target, *, step: float = STEP, **options: Any
) -> Simulation:
    return engine(*hammer(target, law), step=step, settle=0.0, **options)


@functools.cache
def integrated(law: ContactLaw, target: Target) -> tuple[float, Array]:
    """Impulse and the target's state, of the same two bodies by SciPy."""

    def rates(_t: float, z: Array) -> list[float]:
        x, v, travel = z[:3]
        speed = float(target.velocity(z[4:]))
        force = float(law.force(x - travel, v - speed)) if x > travel else 0.0
        return [v, -force / MASS, speed, force, *target.derivative(z[4:], force)]

    start = [0.0, SPEED, 0.0, 0.0, *np.zeros(target.n_states)]
    # no step is longer than what could hide a switch
    run = solve_ivp(rates, (0.0, BLOW), start, method="RK45", rtol=1e-7, atol=1e-10, max_step=4e-5)
    return float(run.y[3, -1]), run.y[4:, -1]


# ---- a point mass


@ENGINES
@pytest.mark.parametrize("damping", [0.0, 100.0])
def test_a_wall_gives_back_what_the_damper_leaves(engine: Engine, damping: float) -> None:
    """zeta = d / (2 sqrt(k m)): e = exp(-2 zeta acos(zeta) / sqrt(1 - zeta^2)), a force of zero ends it."""
    k = 1e5
    sim = blow(engine, KelvinVoigt(stiffness=k, damping=damping), RigidWall())
    zeta = damping / (2 * np.sqrt(k * MASS))
    e = np.exp(-2 * zeta * np.arccos(zeta) / np.sqrt(1 - zeta**2))
    # the step of the first touch misses some of the damper's force, which jumps there
    assert sim.impulse == pytest.approx(MASS * SPEED * (1 + e), rel=2e-5, abs=damping * SPEED * STEP)
    assert sim.hand_speed[-1] == pytest.approx(SPEED - sim.impulse / MASS, rel=1e-9)
    wd = np.sqrt(k / MASS * (1 - zeta**2))
    separation = 2 * np.arccos(zeta) / wd if damping else np.pi / wd
    assert sim.contact_end - sim.contact_start == pytest.approx(separation, rel=2e-4)
    assert (sim.target_speed == 0).all() and sim.outcome == {}
    assert (sim.force >= 0).all()


@ENGINES
@pytest.mark.parametrize("damping", [20.0, 600.0])
def test_the_force_is_that_of_each_instant(engine: Engine, damping: float) -> None:
    """Of a damped spring on a wall: F(0) = c v at touch-down, and k x + c dx/dt of the closed form after it.

    With c^2 > k m the first force is the largest, which a mean over the first step would not show.
    """
    k = 1e5
    sim = blow(engine, KelvinVoigt(stiffness=k, damping=damping), RigidWall())
    start = int(np.flatnonzero(sim.contact_force)[0])
    assert sim.contact_force[start] == pytest.approx(damping * SPEED, rel=1e-5)
    assert sim.contact_force[start - 1] == 0.0
    assert sim.contact_time[start] - sim.contact_time[start - 1] < 1e-9
    zeta, w = damping / (2 * np.sqrt(k * MASS)), np.sqrt(k / MASS)
    wd = w * np.sqrt(1 - zeta**2)

    def exact(t: Array) -> Array:
        x = SPEED / wd * np.exp(-zeta * w * t) * np.sin(wd * t)
        rate = SPEED * np.exp(-zeta * w * t) * np.cos(wd * t) - zeta * w * x
        return np.maximum(k * x + damping * rate, 0.0)

    for time, force in ((sim.contact_time, sim.contact_force), (sim.time, sim.force)):
        inside = (time > sim.contact_start + 1e-9) & (time < sim.contact_end)
        error = force[inside] - exact(time[inside] - sim.contact_start)
        assert np.abs(error).max() < 2e-3 * sim.peak_force
    assert (
        sim.peak_force
        == sim.contact_force.max()
        == pytest.approx(exact(np.linspace(0.0, 2 * np.arccos(zeta) / wd, 20_000)).max(), rel=1e-3)
    )
    assert given_until(sim, sim.time[-1]) == pytest.approx(sim.impulse, rel=1e-4)
    assert sim.touches[0][2] == pytest.approx(sim.impulse, rel=1e-9)
    assert sim.contact_force[-1] == 0.0


@pytest.mark.slow
@ENGINES
@pytest.mark.parametrize(
    ("law", "target"),
    [
        (KelvinVoigt(stiffness=1e5, damping=50.0), FreeMass(mass=1.0)),
        (HuntCrossley(stiffness=3e6, dissipation=0.1), FreeMass(mass=1.0)),
        (HertzDamped(stiffness=3e6, damping=1000.0), RigidWall()),
        (CustomLaw(compression=lambda x, _rate, k: k * ca.fmax(x, 2 * x - 1e-3), k=5e4), FreeMass(mass=1.0)),
        (HuntCrossley(stiffness=3e6, dissipation=0.1), NAIL),
        (SpringDamper(stiffness=1e5, damping=50.0), NAIL),
        (HuntCrossley(stiffness=3e6, dissipation=0.1), BOARD),
        (SpringDamper(stiffness=1e5, damping=50.0), BOARD),
        (SpringDamper(stiffness=1e5, damping=50.0), dataclasses.replace(BOARD, breaking_force=4e3)),
    ],
    ids=lambda x: type(x).__name__,
)
def test_the_blow_is_that_of_an_independent_integration(
    engine: Engine, law: ContactLaw, target: Target
) -> None:
    sim = blow(engine, law, target)
    impulse, state = integrated(law, target)
    missed = float(law.force(1e-12, SPEED)) * STEP
    assert sim.impulse == pytest.approx(impulse, rel=1e-3, abs=missed)
    assert sim.outcome.keys() == target.outcome(state).keys()
    for name, value in target.outcome(state).items():
        assert sim.outcome[name] == pytest.approx(value, rel=4e-3), name
    assert sim.hand_speed[-1] == pytest.approx(SPEED - sim.impulse / MASS, rel=1e-9)


@pytest.mark.slow
@ENGINES
def test_switches_cost_no_accuracy(engine: Engine) -> None:
    """A nail slips and sticks, a board breaks, within steps of the engine: the contact has its own."""
    law = HuntCrossley(stiffness=3e6, dissipation=0.1)
    for target in (NAIL, BOARD):
        exact, _ = integrated(law, target)
        for step in (1e-4, 2.5e-5):
            assert blow(engine, law, target, step=step).impulse == pytest.approx(exact, rel=1e-4), target


# ---- targets that move a thousand times within a step


@ENGINES
@pytest.mark.parametrize("mass", [1e-5, 1e4])
def test_light_and_heavy_targets_of_steel_are_those_of_an_independent_integration(
    engine: Engine, mass: float
) -> None:
    for law in (SpringDamper(stiffness=5e6, damping=200.0), KelvinVoigt(stiffness=5e5, damping=20.0)):
        exact, state = integrated(law, FreeMass(mass=mass))
        sim = blow(engine, law, FreeMass(mass=mass), step=1e-4)
        assert sim.impulse == pytest.approx(exact, rel=1e-3)
        assert sim.outcome["speed_m_s"] == pytest.approx(state[0], rel=1e-3)
        # hammer and target move on for good
        assert len(sim.touches) == 1 and sim.touches[0][2] == pytest.approx(exact, rel=1e-3)


@pytest.mark.slow
@ENGINES
@pytest.mark.parametrize("mass", [1e-4, 5e-3])
def test_a_light_nail_is_driven_as_by_an_independent_integration(engine: Engine, mass: float) -> None:
    law, nail = KelvinVoigt(stiffness=5e5, damping=200.0), Nail(mass=mass, resistance=600.0, hardening=1e4)
    exact, state = integrated(law, nail)
    sim = blow(engine, law, nail, step=2e-4)
    assert sim.impulse == pytest.approx(exact, rel=1e-2)
    assert sim.outcome["depth_m"] == pytest.approx(state[1], rel=1e-2)


@ENGINES
def test_steps_that_leave_the_impulse_uncertain_are_found_out(engine: Engine) -> None:
    there = hammer(FreeMass(mass=1e-3), SpringDamper(stiffness=5e5, damping=20.0))
    fine = with_step_error(engine, *there, settle=0.0)
    assert 0 <= fine.step_error < 1e-2
    check_steps(fine, None)
    assert fine.impulse == pytest.approx(integrated(there[2].law, there[2].target)[0], rel=1e-2)
    with pytest.raises(InputError, match="longer than its motion"):
        with_step_error(engine, *there, settle=0.0, step=1.0)
    coarse = with_step_error(engine, *there, settle=0.0, step=0.06)  # one step, away over the contact
    assert coarse.step_error > 1e-2
    with pytest.raises(InputError, match=r"steps of 0\.06 s leave .* % of its impulse, .* uncertain"):
        check_steps(coarse, 0.06)


def test_draws_whose_steps_leave_the_impulse_uncertain_have_no_result() -> None:
    """As in `validate`: a step of 60 ms goes over the whole blow, those of half a millisecond are halved."""
    law, target = SpringDamper(stiffness=5e5, damping=20.0), FreeMass(mass=1e-3)
    robot, motion, world = hammer(target, law)
    shared = robustness.Shared(robot=robot, reference=motion, scene=world, step=robustness.STEP)
    trusted = robustness.replay(shared, Perturbation())
    assert trusted.impulse == pytest.approx(integrated(law, target)[0], rel=1e-2)
    doubtful = robustness.replay(dataclasses.replace(shared, step=0.06), Perturbation())
    assert not doubtful.standing and np.isnan(doubtful.impulse)
    assert "not reliable: steps of 0.06 s" in doubtful.reason


@ENGINES
def test_a_nail_goes_as_deep_as_the_work_on_its_head_lasts(engine: Engine) -> None:
    """R z + hardening z^2 / 2, and nothing pulls it out again."""
    sim = blow(engine, KelvinVoigt(stiffness=1e5, damping=50.0), NAIL, record=1)
    time, force = sim.contact_time, sim.contact_force
    work = float(np.trapezoid(force * np.interp(time, sim.time, sim.target_speed), time))
    depth = sim.outcome["depth_m"]
    assert sim.target_speed[-1] == 0
    start = NAIL.resistance + NAIL.hardening * NAIL.depth
    assert start * depth + NAIL.hardening * depth**2 / 2 == pytest.approx(work, rel=1e-2)
    assert depth == pytest.approx(STEP * float(sim.target_speed.sum()), rel=5e-3)
    assert depth > 3e-3 and (sim.target_speed >= 0).all()


# ---- perturbations


def test_conditions_change_numbers_that_there_are() -> None:
    there = scene(law=KelvinVoigt(stiffness=1e4, damping=10.0), target=BOARD)
    other = Perturbation(mass=2.0, stiffness=3.0, damping=0.5).scene(there)
    assert other.law == KelvinVoigt(stiffness=3e4, damping=5.0)
    assert other.target == dataclasses.replace(BOARD, mass=0.6)
    wall = scene(law=HuntCrossley(stiffness=1e6, dissipation=0.1), target=RigidWall())
    assert Perturbation(stiffness=2.0).scene(wall).law == HuntCrossley(stiffness=2e6, dissipation=0.1)
    with pytest.raises(InputError, match="perturbation: the target RigidWall has no mass; leave it out"):
        Perturbation(mass=2.0).scene(wall)
    with pytest.raises(InputError, match="perturbation: the law HuntCrossley has no damping"):
        Perturbation(damping=2.0).scene(wall)


def test_what_a_target_does_not_have_is_not_drawn() -> None:
    wall = PerturbationRanges(mass=(0.5, 2.0)).of(scene(target=RigidWall()))
    assert wall == dataclasses.replace(PerturbationRanges(), mass=(1.0, 1.0))
    assert PerturbationRanges().of(scene(target=NAIL)) == PerturbationRanges()


def test_a_nail_that_is_not_there_stays_as_it_was() -> None:
    law = SpringDamper(stiffness=1e5, damping=50.0)
    sim = blow(simulate_mujoco, law, NAIL, step=2e-4, perturbation=Perturbation(missing=True))
    assert sim.impulse == 0 and sim.outcome == {"depth_m": 0.0} and np.isnan(sim.contact_start)


# ---- plans


@pytest.mark.slow
@pytest.mark.parametrize(
    ("target", "changes"),
    [
        (Nail(mass=0.1, resistance=150.0, hardening=1e3), {"collision_elements": FINE}),
        (Board(mass=0.3, stiffness=2e4, breaking_force=50.0), {}),
        (RigidWall(), {"contact_duration": (1e-3, 0.03)}),
    ],
    ids=lambda x: type(x).__name__ if isinstance(x, Target) else "",
)
def test_a_plan_is_replayed_with_what_it_promises(target: Target, changes: dict[str, Any]) -> None:
    """An arm: impulse, force, duration, depth. Its elbow goes where the target's body is.

    MuJoCo's steps are of first order, and a contact that ends with hardly any force ends a little early: by
    0.42, 0.32, 0.22 ms with steps of 100, 50, 25 us.
    """
    law = KelvinVoigt(stiffness=5e4, damping=100.0)
    robot = arm(kp=300.0, kd=10.0)
    problem = dataclasses.replace(
        arm_problem(), robot=robot, law=law, target=target, terms=BODILESS, **changes
    )
    transcription = transcribed(problem)
    result = solve_ipm(transcription.program, first_iterate(transcription))
    assert result.status is Status.SOLVED, result.message
    plan = transcription.decode(result.x)
    motion = dataclasses.replace(plan.trajectory(), end=plan.contact_end + 0.01)  # the blow is what counts
    for name, engine, step in (("pinocchio", simulate_pinocchio, 1e-4), ("mujoco", simulate_mujoco, 2.5e-5)):
        sim = engine(robot, motion, scene_of(problem), step=step, settle=0.0)
        missed = law.damping * plan.hand_speed * step
        assert sim.impulse == pytest.approx(plan.impulse, rel=5e-3, abs=missed), name
        assert sim.peak_force == pytest.approx(plan.collision.force.max(), rel=0.03)
        assert sim.contact_end - sim.contact_start == pytest.approx(
            plan.compression + plan.restitution, rel=0.01, abs=2.1 * step
        )
        assert sim.outcome == pytest.approx(plan.collision.outcome, rel=0.02)
        known = {"torque_limit": robot.torque_limit, "polygon": plan.polygon}
        report = sim.report(**known, planned_impulse=plan.impulse)
        assert report["target"] == sim.outcome
        summary = {"target": plan.collision.outcome, "impulse_Ns": plan.impulse}
        labels = " ".join(map(str, replay_table({**report, "engine": name}, summary).columns[0].cells))
        assert ("driven into the wood" in labels) == isinstance(target, Nail)
        assert ("the board breaks" in labels) == isinstance(target, Board)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mass", "rate", "step"), [(0.05, 300.0, None), (0.2, 1400.0, None), (0.05, 300.0, 4e-4)]
)
def test_the_error_by_the_steps_covers_that_of_a_light_hand_on_a_stiff_servo(
    mass: float, rate: float, step: float | None
) -> None:
    """It drives a nail by less than half a millimetre: steps are too long for the error to follow an order.

    Impulses of one step and of twice it agree by chance.
    """
    speed, begun = 0.5, 0.01
    held = slider(mass, kd=mass * rate, kp=30 * mass * rate, torque_limit=1e4)
    before, after = np.linspace(0.0, begun, 41), np.linspace(begun, 0.04, 41)
    time, far = np.append(before, after), speed * begun / 2
    q = np.append(speed * before**2 / (2 * begun), far + speed * (after - begun))
    v = np.append(speed * before / begun, np.full(41, speed))
    push = np.repeat([mass * speed / begun, 0.0], 41)[:, None]
    ref = reference(time, q[:, None], v[:, None], push, nv=1, n=1)
    law, nail = KelvinVoigt(stiffness=5e5, damping=100.0), Nail(mass=0.05, resistance=12.0, hardening=1e4)
    there = scene(point=np.array([far + 0.002 * speed, 0.0, 0.0]), law=law, target=nail)
    given = {} if step is None else {"step": step}
    done = with_step_error(simulate_mujoco, held, ref, there, settle=0.0, **given)
    exact = simulate_pinocchio(held, ref, there, settle=0.0, step=2e-5).impulse
    assert 1e-4 < abs(done.impulse / exact - 1) <= done.step_error < 1e-2


def test_a_touch_that_lasts_longer_than_what_is_compared_is_no_error_of_the_steps() -> None:
    """A point mass that is pushed back to a wall 11 ms after the blow, and stays there."""
    robot, back = slider(1.0), 50.0
    times = [0.0, 0.1, 0.1, 0.13]
    ref = reference(times, np.zeros(1), torque=[[15.0], [15.0], [back], [back]], nv=1, n=1)
    law = KelvinVoigt(stiffness=2e6, damping=2000.0)
    there = scene(point=np.array([0.075, 0.0, 0.0]), law=law, target=RigidWall())
    done = with_step_error(simulate_pinocchio, robot, ref, there, step=1e-4, settle=0.0)
    (_, end, _), (again, stays, _) = done.touches
    assert 5e-3 < again - end < 0.02 < stays - end
    assert done.step_error < 1e-3


# ---- where the target is


@ENGINES
def test_a_target_that_comes_is_where_its_speed_has_brought_it(engine: Engine) -> None:
    """From before it is hit, at another time than planned, and if it never is."""
    for ahead in (0.0, 0.2):
        robot, ref, there = hammer(
            FreeMass(mass=1.0, initial_velocity=-2.0), SpringDamper(stiffness=1e4, damping=10.0)
        )
        ref.contact_start = 0.05
        there = dataclasses.replace(there, point=there.point + np.array([ahead, 0.0, 0.0]))
        done = engine(robot, ref, there, step=1e-4, settle=0.0)
        assert np.isfinite(done.contact_start) == (not ahead)
        before = done.time < (np.inf if ahead else done.contact_start)
        np.testing.assert_allclose(done.target_travel[before], 2.0 * (0.05 - done.time[before]), atol=1e-9)


@pytest.mark.parametrize("velocity", [0.0, -1.0])
def test_a_clearance_is_to_the_target_where_it_is_in_the_replay(velocity: float) -> None:
    """The robot rests, and the target stands still or comes: displaced, it is as much farther away."""
    wide = TargetBody(shape="box", size=(0.9, 0.9, 0.1))  # so that the elbow is near its face
    target = FreeMass(mass=3.0, initial_velocity=velocity)
    problem = dataclasses.replace(arm_problem(), target=target, body=wide)
    robot, q = problem.robot, problem.start_posture
    torque = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    ref = reference([0.0, 0.1], q, torque=torque, nv=robot.nv, n=robot.n)
    ref.contact_start = ref.contact_end = 0.1
    still = simulate(problem, ref, engine="mujoco", settle=0.0)
    assert np.isnan(still.contact_start) and still.nearest == ("elbow", "target")
    world = Perturbation(distance=0.02)
    away = simulate(problem, ref, engine="mujoco", settle=0.0, perturbation=world)
    assert away.clearance == pytest.approx(still.clearance + 0.02, abs=1e-5)
    bodies = problem.bodies
    came = -velocity * (0.1 - still.time[-1]) * problem.normal
    at = Places.of(robot, q[None], np.zeros(1, dtype=np.intp), came[None])
    assert still.clearance == pytest.approx(bodies.survey(np.zeros(1), at).clearance, abs=1e-5)


# ---- the striking link


@ENGINES
def test_a_link_without_mass_strikes_with_the_masses_about_it(engine: Engine) -> None:
    """A rail; on it turns a link without mass, with the striking point; and on that a mass."""
    model = pin.Model()
    for parent, kind, name, mass in (
        (0, pin.JointModelPX, "rail", MASS / 2),
        (1, pin.JointModelRX, "turn", 0.0),
        (2, pin.JointModelRY, "more", MASS / 2),
    ):
        joint = model.addJoint(parent, kind(), pin.SE3.Identity(), name)
        model.addFrame(pin.Frame(f"link {name}", joint, 0, pin.SE3.Identity(), pin.FrameType.BODY))
        if mass:
            model.appendBodyToJoint(joint, pin.Inertia.FromSphere(mass, 0.05), pin.SE3.Identity())
    robot = Robot.from_model(
        model,
        kp=0.0,
        kd=0.0,
        torque_limit=1e4,
        velocity_limit=10.0,
        position_limit=dict.fromkeys(("rail", "turn", "more"), (-5.0, 5.0)),
        strikers=[Striker(name="tip", frame="link turn", point=np.array([0.1, 0.0, 0.0]))],
    )
    pushed, push = 0.01, 150.0
    torque = [[push, 0.0, 0.0]] * 2 + [[0.0] * 3] * 2
    ref = reference([0.0, pushed, pushed, pushed + 0.01], np.zeros(3), torque=torque, nv=3, n=3)
    point = np.array([0.1 + 0.5 * push / MASS * pushed**2, 0.0, 0.0])
    there = scene(point=point, law=SpringDamper(stiffness=1e6, damping=0.0), target=FreeMass(mass=3.0))
    done = engine(robot, ref, there, settle=0.0)
    speed, reduced = push / MASS * pushed, 1 / (1 / MASS + 1 / 3.0)
    assert done.impulse == pytest.approx(2 * reduced * speed, rel=1e-3)


# ---- the servo's steps


@ENGINES
def test_steps_resolve_a_servo_that_is_faster_than_the_default_ones(engine: Engine) -> None:
    """A hammer on a table, whose damper holds it across the blow, at 1.5e4 1/s, against a constant force.

    It yields to v = f / Kd, at which the demand is zero. The blow along the table does not depend on that, so
    the impulse does not show that the servo is unstable with the engines' default steps, up to its limit.
    """
    force, kd, pushed = 1.0, 1.5e4 * MASS / 2, 0.01
    held = table(MASS, kd=np.array([0.0, kd]))
    times, push = [0.0, pushed, pushed, pushed + 0.008], 150.0
    torque = [[push, force], [push, force], [0.0, force], [0.0, force]]
    ref = reference(times, np.zeros(2), torque=torque, nv=2, n=2)
    point = np.array([0.5 * push / MASS * pushed**2, 0.0, 0.0])
    there = scene(point=point, law=SpringDamper(stiffness=1e6, damping=0.0))
    done = with_step_error(engine, held, ref, there, settle=0.0)
    assert done.impulse > 0 and done.step_error < 1e-2 and done.saturated == 0
    assert np.abs(done.demand[:, 1]).max() == pytest.approx(force)
    assert np.abs(done.v[:, 1]).max() == pytest.approx(force / kd)


def test_a_servo_that_is_sampled_needs_no_shorter_steps_than_its_period() -> None:
    held = slider(1.0, kd=1.5e4, torque_limit=500.0)
    given = held, reference([0.0, 0.02], np.zeros(1), nv=1, n=1), scene()
    assert longest_stable_step(*given) == pytest.approx(1 / 1.5e4)
    for world, longest in (
        (Perturbation(period=1e-3), 1e-3),
        (Perturbation(period=1e-5), 1 / 1.5e4),
        (Perturbation(kd=0.1), 1 / 1.5e3),
    ):
        assert longest_stable_step(*given, perturbation=world) == pytest.approx(longest)
    assert longest_stable_step(slider(1.0, kp=400.0), *given[1:]) == pytest.approx(1 / 20)
    with pytest.raises(InputError, match=r"servo has a rate of .* 1/s, too fast"):
        longest_stable_step(*given, perturbation=Perturbation(kd=100.0))


@pytest.mark.parametrize("rate", [1000.0, 3000.0, 10_000.0])
def test_steps_divide_the_period_of_a_controller(rate: float) -> None:
    """A controller of 3 kHz would else be sampled with 2.5 kHz, one of 10 kHz with 5 kHz.

    Those of the simulation that it is compared with do, too.
    """
    robot = arm()
    q = robot.posture("start")
    data = robot.model.createData()
    torque = np.array(pin.computeGeneralizedGravity(robot.model, data, q))
    ref = reference([0.0, 0.02], q, torque=torque, nv=robot.nv, n=robot.n)
    ref.a, ref.contact_start, ref.contact_end = np.zeros((2, robot.nv)), 0.005, 0.015
    pin.framesForwardKinematics(robot.model, data, q)
    at = scene("striker:hand", target=FreeMass(mass=0.1, initial_velocity=-1.0))
    at = dataclasses.replace(at, point=data.oMf[robot.model.getFrameId("striker:hand")].translation.copy())
    steps = []

    def run(*given: Any, step: float = 2e-4, **options: Any) -> Simulation:
        done = simulate_mujoco(*given, step=step, **options)
        steps.extend(np.diff(done.time))
        return done

    common = {"settle": 0.0, "until": 0.02, "record": 1, "controller": ControllerSettings(rate=rate)}
    assert with_step_error(run, robot, ref, at, **common).step_error < 1e-2
    shares = 1 / rate / np.unique(np.round(steps, 12))
    np.testing.assert_allclose(shares, np.round(shares), rtol=1e-6)
    assert len(shares) > 1 and shares.min() >= 1 - 1e-6
