"""The simplified dynamics computation against closed forms, an independent integration, balances and
differences.

The reference below shares no code with the package: NumPy, Pinocchio's own algorithms, a full KKT matrix in
place of factorizations, SciPy's integrator with located events.
"""

import dataclasses
import functools
import shutil

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp, trapezoid
from scipy.linalg import lu_factor, lu_solve
from support.frozen_cases import (
    FRICTION,
    LAW,
    TARGET,
    Kinematics,
    X,
    robot_named,
    situation,
    slider,
    two_masses,
    with_heavy_feet,
)
from support.small_robots import arm

from impactopt import (
    SDC,
    BothSoles,
    ContactLaw,
    Effects,
    FixedBase,
    FreeMass,
    InputError,
    OneSole,
    SpringDamper,
    Target,
    effective_mass,
    holding_torque,
    posture_of_effective_mass,
    striking_velocity,
)

pytestmark = pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")


@pytest.fixture(autouse=True)
def _virtual_machine(monkeypatch):
    """The graphs are tested as they are; compiling them is another test file's subject."""
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")


def when_met(sdc, q, v, *, mass=None):
    """Kinematics at the velocity that hand and target reach together, as two point masses."""
    frames = sdc.held_by.constraint_frames(sdc.robot)
    k = Kinematics(sdc.robot, q, v, frames, sdc.striker, np.asarray(sdc.normal))
    c = len(k.Jc)
    compliance = np.tile(sdc.held_by.compliance, c // 6) if c else np.zeros(0)
    kkt = np.block([[k.H, -k.Jc.T], [k.Jc, np.diag(compliance)]])
    slowed = np.linalg.solve(kkt, np.concatenate([k.j, np.zeros(c)]))[: sdc.robot.nv]
    impulse = (k.j @ v) / (k.j @ slowed + 1.0 / (mass or sdc.target.mass))
    k = Kinematics(sdc.robot, q, v - impulse * slowed, frames, sdc.striker, np.asarray(sdc.normal))
    k.velocity = v - impulse * slowed
    return k


def reference(sdc, q, v0, feedforward=None, *, rtol=1e-11, **changes):
    """The frozen collision by solve_ivp, phase by phase: impulse, duration, number of phases, velocity,
    displacement."""
    robot, effects = sdc.robot, sdc.effects
    n, nv = robot.n, robot.nv
    k = Kinematics(robot, q, v0, sdc.held_by.constraint_frames(robot), sdc.striker, np.asarray(sdc.normal))
    kp = changes.get("kp", robot.kp) * effects.stiffness
    kd = changes.get("kd", robot.kd)
    limit = robot.torque_limit if effects.saturation else np.full(n, np.inf)
    ff = feedforward if effects.feedforward else np.zeros(n)
    stiffness, damping = changes.get("contact_stiffness", LAW.stiffness), LAW.damping
    mass = changes.get("target_mass", TARGET.mass)
    c = len(k.Jc)
    compliance = np.tile(sdc.held_by.compliance, c // 6) if c else np.zeros(0)
    kkt = np.block([[k.H, -k.Jc.T], [k.Jc, np.diag(compliance)]])
    inverse = np.linalg.inv(kkt)
    met = when_met(sdc, q, v0, mass=mass)
    gamma = met.gamma if effects.jdot else np.zeros(c)
    hand_drift = met.hand_drift if effects.jdot else 0.0
    bias = met.bias if effects.bias else np.zeros(nv)
    friction = sdc.friction
    viscous, coulomb = friction.arrays(n) if friction else (np.zeros(n), np.zeros(n))
    band = friction.transition if friction else 1.0

    def unpack(y):
        v, p = y[:nv], y[nv : 2 * nv]
        speed, x, target = y[2 * nv :]
        return v, p, speed, x, target

    def demand(t, y):
        v, p, *_ = unpack(y)
        return ff + kp * (v0 * t - p)[-n:] + kd * (v0 - v)[-n:]

    def force(y, compressing):
        _, _, speed, x, target = unpack(y)
        return stiffness * x + (damping * (speed - target) if compressing else 0.0)

    def acceleration(tau, f):
        push = -k.j * f - bias
        push[-n:] += tau
        return (inverse @ np.concatenate([push, -gamma]))[:nv]

    def make(saturated, sliding, compressing):
        def torque(t, y):
            v = y[:nv][-n:]
            tau = np.where(saturated == 0, demand(t, y), saturated * np.where(np.isinf(limit), 0.0, limit))
            return tau - viscous * v - coulomb * np.where(sliding == 0, v / band, sliding)

        def flow(t, y):
            v, _, speed, _, target = unpack(y)
            f = force(y, compressing)
            a = acceleration(torque(t, y), f)
            return np.concatenate([a, v, [k.j @ a + hand_drift, speed - target, f / mass]])

        def margins(t, y):
            _, _, speed, _, target = unpack(y)
            d, v = demand(t, y), y[:nv][-n:]
            out = np.where(saturated == 0, limit - np.abs(d), saturated * d - limit)
            out = np.where(np.isinf(limit), 1.0, out)
            slide = np.where(sliding == 0, band - np.abs(v), sliding * v - band) if friction else np.ones(n)
            rate = speed - target
            return np.concatenate(
                [out, slide, [rate if compressing else -rate, 1.0 if compressing else force(y, False)]]
            )

        return flow, margins

    y = np.concatenate([v0, np.zeros(nv), [k.j @ v0, 0.0, 0.0]])
    t, phases = 0.0, 0
    d = demand(0.0, y)
    saturated = np.where(np.abs(d) > limit, np.sign(d), 0.0)
    sliding = np.where(np.abs(v0[-n:]) > band, np.sign(v0[-n:]), 0.0)
    compressing = True
    while True:
        phases += 1
        flow, margins = make(saturated, sliding, compressing)
        seen = {}

        def margin(i, t, y, seen=seen, margins=margins):
            key = (t, y.tobytes())
            if key not in seen:
                seen.clear()
                seen[key] = margins(t, y)
            return seen[key][i]

        events = []
        for i in range(2 * n + 2):
            event = functools.partial(margin, i)
            event.terminal, event.direction = True, -1.0
            events.append(event)
        # a joint may saturate and come back within a longer step, unseen
        options = {"method": "DOP853", "rtol": rtol, "atol": 1e-13, "max_step": 2e-4}
        run = solve_ivp(flow, (t, 0.3), y, events=events, **options)
        t, y = run.t[-1], run.y[:, -1]
        first = next((i for i, hits in enumerate(run.t_events) if len(hits)), None)
        assert first is not None, "the contact does not end"
        if first == 2 * n + 1:
            break
        if first == 2 * n:
            compressing = not compressing
        elif first < n:
            saturated = saturated.copy()
            saturated[first] = np.sign(demand(t, y)[first]) if saturated[first] == 0 else 0.0
        else:
            sliding = sliding.copy()
            i = first - n
            sliding[i] = np.sign(y[:nv][-n:][i]) if sliding[i] == 0 else 0.0
    v, p, _, _, target = unpack(y)
    return {"impulse": mass * target, "duration": t, "phases": phases, "velocity": v, "displacement": p}


def make(robot, **options):
    # histories in steps, as they are summed up here; no second model for the error of freezing
    given = {"striker": "right_hand", "step": 2.5e-4, "accuracy": None, **options}
    return SDC(robot=robot, normal=X, law=LAW, target=TARGET, **given)


def make_arm(**options):
    """A collision of a small arm, and its configuration, velocity and torque."""
    robot = arm()
    sdc = make(robot, striker="hand", **options)
    return sdc, robot.posture("start"), np.full(robot.nv, 0.5), 0.1 * robot.torque_limit


@pytest.mark.parametrize(
    "mass, target, stiffness, damping, speed",
    [
        (4.0, 5.0, 1e4, 300.0, 0.4),
        (8.0, 2.0, 3e4, 40.0, 1.5),
        (1.0, 50.0, 1e3, 500.0, 2.0),
        (6.0, 5.0, 1e4, 0.0, 1.0),
    ],
)
def test_two_free_masses_in_closed_form(mass, target, stiffness, damping, speed):
    sdc = SDC(
        robot=slider(mass),
        striker="tip",
        normal=X,
        law=SpringDamper(stiffness=stiffness, damping=damping),
        target=FreeMass(mass=target),
        horizon=0.5,
        tolerance=1e-9,
        accuracy=None,
    )
    result = sdc.collide([0.0], [speed], [0.0])
    impulse, duration = two_masses(mass, target, stiffness, damping, speed)
    assert result.impulse == pytest.approx(impulse, rel=1e-7)
    assert result.duration == pytest.approx(duration, rel=1e-6)
    assert result.energy == pytest.approx(impulse**2 / (2 * target), rel=1e-7)
    assert result.velocity == pytest.approx([speed - impulse / mass], rel=1e-7)
    assert result.force[0] == pytest.approx(damping * speed)
    assert result.force[-1] == 0.0


def test_two_free_masses_give_the_papers_table_iii():
    """Impulses that the paper prints for its virtual mass model, whose laws the paper does not write out."""
    printed = {4.0: (1.2, 2.1, 3.0), 6.0: (1.5, 2.7, 3.8), 8.0: (1.7, 3.0, 4.3)}
    for mass, impulses in printed.items():
        sdc = SDC.paper(slider(mass), striker="tip", normal=X)
        for speed, impulse in zip((0.4, 0.7, 1.0), impulses, strict=True):
            result = sdc.collide([0.0], [speed])
            assert round(result.impulse, 1) == impulse
            assert result.peak_force == pytest.approx(300.0 * speed, rel=0.01)


# ------------------------------------------------------------ independent integration
ALL = Effects(friction=True)
PAPER = Effects.paper()


NONE = dataclasses.replace(PAPER, saturation=False)


@pytest.mark.parametrize(
    "effects",
    [
        PAPER,
        dataclasses.replace(NONE, stiffness=True, feedforward=True, friction=True),
        dataclasses.replace(NONE, stiffness=True, saturation=True, bias=True),
        dataclasses.replace(NONE, feedforward=True, saturation=True, jdot=True),
        ALL,
    ],
    ids=lambda effects: "+".join(name for name, on in dataclasses.asdict(effects).items() if on),
)
def test_each_term_against_an_independent_integration(effects):
    """Each is on and off, and no two are on in the same cases: one that follows another's switch is found."""
    robot = robot_named("talos")
    sdc = make(robot, effects=effects, friction=FRICTION if effects.friction else None)
    q, v, torque = situation(robot, seed=1, speed=1.5)
    expected = reference(sdc, q, v, torque)
    result = sdc.collide(q, v, torque if effects.feedforward else None)
    assert result.separated
    assert result.impulse == pytest.approx(expected["impulse"], rel=1e-7)
    assert result.duration == pytest.approx(expected["duration"], rel=1e-6)
    np.testing.assert_allclose(result.velocity, expected["velocity"], atol=1e-5)
    after = pin.integrate(robot.model, q, expected["displacement"])
    np.testing.assert_allclose(result.configuration, after, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("gain", [20.0, 150.0, 300.0])
@pytest.mark.parametrize("seed", [2, 3])
def test_impulse_over_postures_speeds_and_gains(speed, gain, seed):
    robot, sdc = robot_named("talos"), default_sdc("talos")
    q, v, torque = situation(robot, seed=seed, speed=speed)
    kd = np.full(robot.n, gain)
    gains = {"kd": kd, "kp": 30.0 * kd}
    expected = reference(sdc, q, v, torque, **gains)
    if speed == 3.0 and gain > 20.0:
        assert expected["phases"] > 6, "the case was meant to saturate several joints"
    assert sdc.collide(q, v, torque, **gains).impulse == pytest.approx(expected["impulse"], rel=1e-7)


@pytest.mark.slow
def test_infinite_torque_limits_are_no_limits():
    robot, sdc = robot_named("talos"), default_sdc("talos")
    q, v, torque = situation(robot, seed=15, speed=2.0)
    unlimited = make(robot, effects=Effects(saturation=False)).collide(q, v, torque)
    result = sdc.collide(q, v, torque, torque_limit=np.inf)
    assert result.impulse == pytest.approx(unlimited.impulse, rel=1e-10)
    assert abs(result.impulse / sdc.collide(q, v, torque).impulse - 1.0) > 1e-5


@functools.cache
def default_sdc(name):
    return make(robot_named(name))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, stance",
    [
        ("g1", BothSoles()),
        ("g1", OneSole("left")),
        ("g1", BothSoles(base_mass=1e3, base_inertia=50.0)),
        ("talos_fixed", None),
    ],
    ids=["both soles", "one sole", "virtual base", "fixed base"],
)
def test_stances_against_an_independent_integration(name, stance):
    robot = robot_named(name)
    normal = np.array([0.6, 0.0, 0.8])
    sdc = SDC(robot=robot, striker="left_hand", normal=normal, law=LAW, target=TARGET, stance=stance)
    soles = sdc.held_by.soles(robot)
    q, v, torque = situation(robot, seed=4, speed=2.0, soles=soles, striker="left_hand", normal=normal)
    changes = {"contact_stiffness": 4e4, "target_mass": 0.7}
    expected = reference(sdc, q, v, torque, **changes)
    result = sdc.collide(q, v, torque, **changes)
    assert result.impulse == pytest.approx(expected["impulse"], rel=1e-6)
    np.testing.assert_allclose(result.velocity, expected["velocity"], atol=1e-5)


# ------------------------------------------------------------ laws and targets of one's own
@dataclasses.dataclass(frozen=True, kw_only=True)
class HardeningSpring(ContactLaw):
    stiffness: float
    hardening: float
    damping: float

    def branch(self, penetration, rate, compressing, parameters=None):
        p = parameters or self.parameters
        f = p["stiffness"] * penetration + p["hardening"] * penetration**3
        return f + p["damping"] * penetration * rate if compressing else f


@dataclasses.dataclass(frozen=True, kw_only=True)
class SprungMass(Target):
    mass: float
    stiffness: float
    drag: float

    n_states = 2

    def velocity(self, state, parameters=None):
        return state[1]

    def derivative(self, state, force, parameters=None):
        p = parameters or self.parameters
        push = force - p["stiffness"] * state[0] - p["drag"] * state[1] * state[1]
        return [state[1], push / p["mass"]]

    def energy(self, state, parameters=None):
        p = parameters or self.parameters
        return 0.5 * (p["mass"] * state[1] ** 2 + p["stiffness"] * state[0] ** 2)


@pytest.mark.slow
def test_a_nonlinear_law_and_target_against_an_independent_integration():
    law = HardeningSpring(stiffness=1e4, hardening=4e8, damping=2e4)
    target = SprungMass(mass=2.0, stiffness=500.0, drag=3.0)
    sdc = SDC(robot=slider(3.0), striker="tip", normal=X, law=law, target=target)

    def flow(compressing, t, y):
        hand, x, place, speed, _ = y
        f = 1e4 * x + 4e8 * x**3 + (2e4 * x * (hand - speed) if compressing else 0.0)
        return [-f / 3.0, hand - speed, speed, (f - 500.0 * place - 3.0 * speed**2) / 2.0, f]

    def turning(t, y):
        return y[0] - y[3]

    def leaving(t, y):
        return y[1]

    turning.terminal = leaving.terminal = True
    turning.direction = leaving.direction = -1
    y, t = [1.5, 0.0, 0.0, 0.0, 0.0], 0.0
    for compressing, event in ((True, turning), (False, leaving)):
        run = solve_ivp(
            functools.partial(flow, compressing),
            (t, 1.0),
            y,
            method="DOP853",
            rtol=1e-11,
            atol=1e-13,
            events=event,
        )
        t, y = run.t[-1], run.y[:, -1]
    result = sdc.collide([0.0], [1.5], [0.0])
    assert result.impulse == pytest.approx(y[4], rel=1e-6)
    assert result.duration == pytest.approx(t, rel=1e-5)
    assert result.energy == pytest.approx(0.5 * (2.0 * y[3] ** 2 + 500.0 * y[2] ** 2), rel=1e-6)
    plain = dataclasses.replace(sdc, method="rk4", step=2e-5).collide([0.0], [1.5], [0.0])
    assert plain.impulse == pytest.approx(y[4], rel=1e-6)


# ------------------------------------------------------------ balances
@pytest.mark.slow
@pytest.mark.parametrize("effects", [PAPER, Effects(), ALL], ids=["paper", "default", "all"])
def test_ground_wrench_is_what_the_robots_momentum_needs(effects):
    """d/dt of the centroidal momentum (Pinocchio) = ground + weight + reaction at the hand, at every step."""
    robot = robot_named("talos")
    sdc = make(robot, effects=effects, friction=FRICTION if effects.friction else None)
    q, v, torque = situation(robot, seed=5, speed=1.0)
    result = sdc.collide(q, v, torque if effects.feedforward else None)
    k = Kinematics(robot, q, v, [s.frame for s in robot.soles], "right_hand", X)
    drifts_at = v
    if effects.bias:
        k = when_met(sdc, q, v)
        drifts_at = k.velocity
    model, data = robot.model, robot.model.createData()
    viscous, coulomb = FRICTION.arrays(robot.n)
    for i in range(0, len(result.time), 40):
        tau = result.torque[i].copy()
        if effects.friction:
            rate = result.joint_velocity[i]
            tau -= viscous * rate + coulomb * np.clip(rate / FRICTION.transition, -1.0, 1.0)
        push = -k.j * result.force[i] - (k.bias if effects.bias else 0.0)
        push[6:] += tau
        wrench = result.sole_wrench[i]
        a = np.linalg.solve(k.H, push + k.Jc.T @ wrench.ravel())
        np.testing.assert_allclose(k.Jc @ a, -k.gamma if effects.jdot else np.zeros(12), atol=1e-8)
        rate = pin.computeCentroidalMomentumTimeVariation(model, data, q, drifts_at, a)
        com = pin.centerOfMass(model, data, q)
        weight = pin.computeTotalMass(model) * model.gravity.linear
        ground = result.ground_wrench[i]
        f_hand = -X * result.force[i]
        force = ground[:3] + weight + f_hand
        moment = ground[3:] - np.cross(com, ground[:3]) + np.cross(k.hand_position - com, f_hand)
        np.testing.assert_allclose(force, rate.linear, atol=1e-7)
        np.testing.assert_allclose(moment, rate.angular, atol=1e-7)
        if effects.bias:
            of_soles = sum(wrench[:, :3])
            np.testing.assert_allclose(of_soles, ground[:3], atol=1e-8)
        point = np.array([*result.zmp[i], 0.0])
        np.testing.assert_allclose((ground[3:] - np.cross(point, ground[:3]))[:2], 0.0, atol=1e-8)


def test_impulse_is_the_targets_gain_and_the_robots_loss_to_it():
    robot = robot_named("talos")
    sdc = default_sdc("talos")
    q, v, torque = situation(robot, seed=6, speed=1.2)
    result = sdc.collide(q, v, torque)
    assert result.impulse == pytest.approx(TARGET.mass * result.target_speed[-1], rel=1e-12)
    assert result.energy == pytest.approx(0.5 * TARGET.mass * result.target_speed[-1] ** 2, rel=1e-12)
    model, data = robot.model, robot.model.createData()

    def momentum(velocity):
        return pin.computeCentroidalMomentum(model, data, q, velocity).linear.copy()

    met = when_met(sdc, q, v).velocity
    drift = pin.computeCentroidalMomentumTimeVariation(model, data, q, met, np.zeros(model.nv)).linear
    change = momentum(result.velocity) - momentum(v) + drift * result.duration
    weight = pin.computeTotalMass(model) * model.gravity.linear * result.duration
    ground = trapezoid(result.ground_wrench[:, :3], result.time, axis=0)
    # the trapezoidal rule on the histories is what limits this
    np.testing.assert_allclose(change, ground + weight - result.impulse * X, atol=2e-3)
    assert trapezoid(result.force, result.time) == pytest.approx(result.impulse, rel=2e-3)


def test_histories_hang_together():
    robot, sdc = robot_named("talos"), default_sdc("talos")
    q, v, torque = situation(robot, seed=7, speed=3.0)
    result = sdc.collide(q, v, torque)
    k = len(result.time)
    assert result.time[0] == 0.0 and result.time[-1] == result.duration
    assert (np.diff(result.time) > 0).all() and np.diff(result.time).max() <= sdc.step_length * (1 + 1e-12)
    assert result.torque.shape == (k, robot.n) and result.sole_wrench.shape == (k, 2, 6)
    assert (np.abs(result.torque) <= robot.torque_limit * (1 + 1e-12)).all()
    assert (np.abs(result.demand) > robot.torque_limit).any(), "the case was meant to saturate"
    np.testing.assert_array_equal(
        result.torque, np.clip(result.demand, -robot.torque_limit, robot.torque_limit)
    )
    np.testing.assert_allclose(result.demand[0], torque)
    np.testing.assert_allclose(result.joint_velocity[0], v[6:])
    np.testing.assert_allclose(result.joint_velocity[-1], result.velocity[6:])
    assert result.peak_force == pytest.approx(result.force.max())
    assert result.hand_speed[0] == pytest.approx(3.0)
    np.testing.assert_allclose(np.diff(result.penetration).sum(), result.penetration[-1], atol=1e-12)
    assert result.force[-1] == 0.0 and (result.force >= 0).all()


def test_every_keeps_every_so_many_steps_and_the_last():
    sdc, q, v, torque = make_arm()
    fine = sdc.function(("time", "torque"))(q, v, torque)
    coarse = sdc.function(("time", "torque"), every=16)(q, v, torque)
    for a, b in zip(fine, coarse, strict=True):
        a, b = np.array(a), np.array(b)
        a = a.T if a.shape[1] > 1 else a
        b = b.T if b.shape[1] > 1 else b
        np.testing.assert_array_equal(b[:-1], a[:-1:16])
        np.testing.assert_array_equal(b[-1], a[-1])


def test_virtual_base_is_masses_added_to_the_feet_and_tends_to_the_exact_constraint():
    robot = robot_named("talos")
    q, v, _ = situation(robot, seed=11)
    k = Kinematics(robot, q, v, [s.frame for s in robot.soles], "right_hand", X)
    exact = float(effective_mass(robot, striker="right_hand", normal=X)(q))
    Y = np.linalg.solve(k.H, np.vstack([k.Jc, k.j]).T)
    G = k.Jc @ Y[:, :12]
    assert 1 / exact == pytest.approx(
        k.j @ (Y[:, 12] - Y[:, :12] @ np.linalg.solve(G, k.Jc @ Y[:, 12])), rel=1e-9
    )
    errors = []
    for mass in (1e2, 1e3, 1e4):
        stance = BothSoles(base_mass=mass, base_inertia=mass)
        found = float(effective_mass(robot, striker="right_hand", normal=X, stance=stance)(q))
        model = with_heavy_feet(robot, mass, mass)
        H = pin.crba(model, model.createData(), q)
        H = np.triu(H) + np.triu(H, 1).T
        assert found == pytest.approx(1 / (k.j @ np.linalg.solve(H, k.j)), rel=1e-9)
        errors.append(abs(found - exact))
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.2)
    assert errors[1] / errors[2] == pytest.approx(10.0, rel=0.2)


# ------------------------------------------------------------ the paper's own steps
def test_paper_is_its_steps_1b_to_8b_word_for_word():
    """Virtual base in H, LU before the loop, Runge-Kutta at 1e-4 s; eqs. (9), (11), (12), (15), (16),
    (17)."""
    robot = robot_named("talos")
    q, v, _ = situation(robot, seed=12, speed=3.0)
    k = Kinematics(robot, q, v, [s.frame for s in robot.soles], "right_hand", X)
    model = with_heavy_feet(robot, 1e5, 1e5)
    H = pin.crba(model, model.createData(), q)
    lu = lu_factor(np.triu(H) + np.triu(H, 1).T)  # steps 1b, 2b
    limit, kd = robot.torque_limit, robot.kd

    def rates(y):
        velocity, (w, x, target) = y[:-3], y[-3:]
        tau = np.clip(kd * (v - velocity)[6:], -limit, limit)  # step 3b
        f = 1e4 * x + 300.0 * max(w - target, 0.0) if x >= 0 else 0.0
        push = -k.j * f
        push[6:] += tau
        a = lu_solve(lu, push)  # steps 4b, 5b
        return np.concatenate([a, [k.j @ a, w - target, f / 5.0]]), f  # steps 6b, 7b

    y, h, forces = np.concatenate([v, [k.j @ v, 0.0, 0.0]]), 1e-4, []
    while not (y[-2] <= 0 and y[-3] < y[-1]):
        k1, f = rates(y)
        k2, _ = rates(y + h / 2 * k1)
        k3, _ = rates(y + h / 2 * k2)
        k4, _ = rates(y + h * k3)
        forces.append(f)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)  # step 8b
    result = SDC.paper(robot, striker="right_hand", normal=X).collide(q, v)
    assert len(result.time) == len(forces) + 1
    np.testing.assert_allclose(result.force[:-1], forces, rtol=1e-6, atol=1e-6)
    assert result.impulse == pytest.approx(5.0 * y[-1], rel=1e-8)
    np.testing.assert_allclose(result.velocity, y[:-3], atol=1e-6)
    assert result.duration == pytest.approx(h * len(forces))


# ------------------------------------------------------------ compiled
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_compiled_functions_give_what_the_graphs_give(tmp_path, monkeypatch):
    arguments = ([0.0], [1.3], [0.2])

    def results():
        given = {"robot": slider(2.5), "striker": "tip", "normal": X, "law": LAW, "target": TARGET}
        sdc = SDC(**given, method="rk4", horizon=0.1)
        gradient = sdc.gradient_function()(*arguments)
        return [
            *gradient,
            sdc.function(("impulse", "peak_force", "duration"), parameters=("kd",))(*arguments, [2.0])[0],
        ]

    interpreted = results()
    tmp_path.chmod(0o700)
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path))
    monkeypatch.delenv("IMPACTOPT_NO_COMPILER")
    compiled = results()
    assert list(tmp_path.glob("*.so"))
    for a, b in zip(interpreted, compiled, strict=True):
        np.testing.assert_allclose(np.array(b), np.array(a), rtol=1e-12)


# ------------------------------------------------------------ phases that do not come
def test_a_hand_that_moves_away_gives_nothing():
    robot, sdc = robot_named("talos"), default_sdc("talos")
    q, v, torque = situation(robot, seed=13, speed=-1.0)
    result = sdc.collide(q, v, torque)
    assert result.separated and result.impulse == 0.0 and result.duration == 0.0 and result.peak_force == 0.0
    np.testing.assert_array_equal(result.velocity, v)


def test_a_contact_that_outlasts_the_horizon_is_said_to():
    sdc = SDC(robot=slider(4.0), striker="tip", normal=X, law=LAW, target=FreeMass(mass=5.0), horizon=0.01)
    with pytest.raises(InputError, match="horizon"):
        sdc.collide([0.0], [1.0], [0.0])
    result = sdc.collide([0.0], [1.0], [0.0], require_separation=False)
    assert not result.separated and result.impulse > 0
    assert float(sdc.function(("separated",))([0.0], [1.0], [0.0])) == 0.0


def test_stable_step_is_where_the_method_turns_unstable():
    sdc, q, v, torque = make_arm()
    kd = np.full(sdc.robot.n, 2000.0)
    longest = sdc.stable_step(q, kd=kd)
    free = dataclasses.replace(Effects(), saturation=False)

    def final_speed(step):
        sdc, *_ = make_arm(effects=free, step=step, method="rk4", horizon=120 * step)
        function = sdc.function(("velocity", "separated"), parameters=("kd",))
        return np.abs(np.array(function(q, v, 0 * torque, kd)[0])).max()

    assert final_speed(0.95 * longest) < 10.0
    assert final_speed(1.15 * longest) > 1e3
    with pytest.raises(InputError, match="unstable"):
        make_arm(step=1.05 * longest, method="rk4")[0].collide(q, v, torque, kd=kd)


# ------------------------------------------------------------ bad input
@pytest.mark.parametrize(
    "options, message",
    [
        ({"striker": "right_hnad"}, r"did you mean 'right_hand'"),
        ({"normal": [1.0, 1.0, 0.0]}, r"normal: not a unit vector"),
        ({"normal": [1.0, 0.0]}, r"normal: expected shape"),
        ({"normal": [np.nan, 0.0, 1.0]}, r"normal: nan"),
        ({"stance": FixedBase()}, r"free-flyer"),
        ({"method": "rk5"}, r"method 'rk5' \(did you mean 'rk4'"),
        ({"step": 0.0}, r"step"),
        ({"step": 0.5}, r"longer than the horizon"),
        ({"horizon": -0.1}, r"horizon"),
        ({"effects": Effects(friction=True)}, r"JointFriction"),
        ({"friction": FRICTION}, r"effects.friction is off"),
        ({"robot": "talos"}, r"robot must be a Robot, not 'talos'"),
        ({"stance": "both"}, r"stance must be a Stance, not 'both'"),
        ({"effects": "paper"}, r"effects must be an Effects, not 'paper'"),
        ({"effects": Effects(friction=True), "friction": 0.1}, r"friction must be a JointFriction, not 0.1"),
        ({"law": SpringDamper}, r"law must be a ContactLaw, not <class"),
        ({"law": None}, r"law must be a ContactLaw, not None"),
        ({"target": 5.0}, r"target must be a Target, not 5.0"),
    ],
)
def test_bad_models_are_refused_before_anything_is_built(options, message):
    scene = {
        "robot": robot_named("talos"),
        "striker": "right_hand",
        "normal": X,
        "law": LAW,
        "target": TARGET,
    }
    with pytest.raises(InputError, match=message):
        SDC(**(scene | options))


@pytest.mark.parametrize(
    "function",
    [
        lambda robot, **stance: effective_mass(robot, striker="right_hand", normal=X, **stance),
        lambda robot, **stance: holding_torque(robot, np.zeros(35), **stance),
        lambda robot, **stance: striking_velocity(robot, np.zeros(35), "right_hand", X, 1.0, **stance),
        lambda robot, **stance: posture_of_effective_mass(robot, 5.0, "right_hand", X, **stance),
    ],
)
def test_states_to_start_from_refuse_what_is_no_robot_or_stance(function):
    with pytest.raises(InputError, match="robot must be a Robot, not 'talos'"):
        function("talos")
    with pytest.raises(InputError, match="stance must be a Stance, not 'both'"):
        function(robot_named("talos"), stance="both")


def test_a_batch_refuses_the_configurations_that_a_collision_refuses():
    robot = arm()  # whose first joint is continuous
    sdc = SDC(robot=robot, striker="hand", normal=X, law=LAW, target=TARGET, accuracy=None)
    q, v = robot.posture("start"), np.ones(robot.nv)
    twice = np.concatenate([2 * q[:2], q[2:]])
    message = r"\(cosine, sine\) of joint 'turn' has norm 2"
    with pytest.raises(InputError, match=message):
        sdc.collide(twice, v, np.zeros(robot.n))
    with pytest.raises(InputError, match=f"q of collision 1: the {message}"):
        sdc.batch([q, twice], [v, v], np.zeros(robot.n))


def test_bad_numbers_are_refused():
    robot, sdc = robot_named("talos"), default_sdc("talos")
    q, v, torque = situation(robot)
    for changes, message in (
        ({"q": q[:-1]}, r"q: expected shape"),
        ({"q": 2 * q}, r"q"),
        ({"v": np.where(np.arange(robot.nv) == 3, np.nan, v)}, r"v: nan at index 3"),
        ({"torque": None}, r"torque: give"),
        ({"torque": torque[:-1]}, r"torque"),
        ({"kd": -1.0}, r"kd: has -1"),
        ({"kd": np.ones(3)}, r"kd: expected shape"),
        ({"target_mass": 0.0}, r"FreeMass: mass"),
        ({"contact_stiffness": -1.0}, r"SpringDamper: stiffness"),
        ({"contact_dampning": 1.0}, r"did you mean 'contact_damping'"),
        ({"normal": 2 * X}, r"unit vector"),
        ({"viscous": 1.0}, r"no setting 'viscous'"),
    ):
        with pytest.raises(InputError, match=message):
            sdc.collide(**{"q": q, "v": v, "torque": torque, **changes})
    for outputs, message in (
        (("impluse",), r"did you mean 'impulse'"),
        ("impulse", r"give a tuple of names, \('impulse',\)"),
    ):
        with pytest.raises(InputError, match=message):
            sdc.function(outputs)
    with pytest.raises(InputError, match="gradient of 'torque'"):
        sdc.gradient_function("torque")
    with pytest.raises(InputError, match="no soles"):
        make(robot_named("talos_fixed")).function(("zmp",))
    with pytest.raises(InputError, match="unit vector"):
        effective_mass(robot, striker="right_hand", normal=2 * X)
