"""The hierarchy of collision models, from point mass to several freezes; held hands, matrices of gains."""

import dataclasses
import functools

import numpy as np
import pinocchio as pin
import pytest
from support import small_robots
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
)

from impactopt import (
    SDC,
    BothSoles,
    Effects,
    FreeMass,
    FullDynamics,
    HuntCrossley,
    ImpactProblem,
    InputError,
    RigidBody,
    RigidWall,
    SpringDamper,
    VirtualMass,
    effective_mass,
    holding_torque,
    striking_velocity,
    talos,
)
from impactopt.collision import Collision


def models(robot, **options):
    given = {"robot": robot, "striker": "right_hand", "normal": X, "law": LAW, "target": TARGET, **options}
    steps = {"tolerance": 1e-10, "step": 2.5e-4}
    return {
        "point": VirtualMass(**given, **steps),
        "paper": SDC(**given, **steps, effects=Effects.paper()),
        "repaired": SDC(**given, **steps),
        "frozen again": SDC(**given, **steps, freezes=4),
        "full": FullDynamics(**given),
    }


@functools.cache
def small():
    """A biped of few joints, whose functions are compiled in a third of the time."""
    return small_robots.biped()


FIST = {"striker": "fist", "moved": 3}


def inside_the_hand():
    """TALOS with its striking points where the fingers' inner links end."""
    return talos(
        strikers=[dataclasses.replace(s, point=[0.0, 0.0, -0.125]) for s in talos().strikers.values()]
    )


# ------------------------------------------------------------ one interface
@pytest.mark.slow
def test_every_rung_takes_the_same_and_gives_the_same_kind_of_result():
    robot = small()
    q, v, torque = situation(robot, **FIST)
    for name, model in models(robot, striker="fist").items():
        result = model.collide(q, v, torque)
        assert isinstance(result, Collision) and result.separated, name
        assert result.target_result == {"speed": pytest.approx(result.impulse / TARGET.mass, rel=1e-9)}
        k = len(result.time)
        assert result.force.shape == result.penetration.shape == result.hand_speed.shape == (k,)
        known = name != "point"
        shapes = {"joint_velocity": (k, robot.n), "torque": (k, robot.n), "demand": (k, robot.n)}
        shapes |= {"sole_wrench": (k, 2, 6), "ground_wrench": (k, 6), "zmp": (k, 2)}
        for field, shape in shapes.items():
            value = getattr(result, field)
            assert value.shape == shape if known else value is None, (name, field)
        assert result.hand_wrench is None
        assert result.velocity.shape == (robot.nv,) and result.configuration.shape == (robot.nq,)


@pytest.mark.slow
def test_each_rung_is_nearer_to_full_dynamics_than_the_one_below():
    robot = small()
    q, v, torque = situation(robot, seed=3, speed=1.5, **FIST)
    found = {
        name: model.collide(q, v, torque).impulse for name, model in models(robot, striker="fist").items()
    }
    errors = [abs(found[name] / found["full"] - 1) for name in list(found)[:-1]]
    assert errors[0] > errors[1] > errors[2] > errors[3], errors


# ------------------------------------------------------------ the point mass
def test_virtual_mass_is_a_free_mass_of_the_effective_mass():
    robot = small()
    q, v, torque = situation(robot, seed=2, **FIST)
    mass = float(effective_mass(robot, striker="fist", normal=X)(q))
    impulse, duration = two_masses(mass, TARGET.mass, LAW.stiffness, LAW.damping, 1.0)
    result = models(robot, striker="fist")["point"].collide(q, v, torque)
    assert result.impulse == pytest.approx(impulse, rel=1e-8)
    assert result.duration == pytest.approx(duration, rel=1e-6)
    assert result.hand_speed[-1] == pytest.approx(1.0 - impulse / mass, rel=1e-7)
    k = Kinematics(robot, q, result.velocity, [s.frame for s in robot.soles], "fist", X)
    assert k.j @ result.velocity == pytest.approx(result.hand_speed[-1], rel=1e-7)
    np.testing.assert_allclose(k.Jc @ result.velocity, 0.0, atol=1e-9)


def test_virtual_mass_says_what_it_does_not_know():
    model = models(small(), striker="fist")["point"]
    with pytest.raises(InputError, match="'zmp': a point mass knows nothing of it"):
        model.function(("zmp",))
    assert "kd" not in model.settings


# ------------------------------------------------------------ several freezes
@pytest.mark.parametrize("seed, speed", [(0, 1.0), (3, 2.0)])
@pytest.mark.slow
def test_freezes_converge_to_full_dynamics_with_their_square(seed, speed):
    robot = robot_named("talos")
    q, v, torque = situation(robot, seed=seed, speed=speed)
    options = {"robot": robot, "striker": "right_hand", "normal": X, "law": LAW, "target": TARGET}
    full = FullDynamics(**options, step=2.5e-5).collide(q, v, torque)
    joints, impulses, counts = [], [], np.array([4, 8, 16])
    for freezes in counts:
        result = SDC(**options, freezes=int(freezes)).collide(q, v, torque)
        way = pin.difference(robot.model, full.configuration, result.configuration)
        joints.append(np.abs(way).max())
        impulses.append(abs(result.impulse / full.impulse - 1.0))
    assert -np.polyfit(np.log(counts), np.log(joints), 1)[0] > 1.7, joints
    assert impulses[-1] < 5e-4 and impulses[-1] < impulses[0] / 4, impulses


@pytest.mark.slow
def test_histories_of_several_freezes_go_on_from_one_to_the_next():
    robot = robot_named("talos")
    q, v, torque = situation(robot, seed=7, speed=3.0)
    all_effects = Effects(friction=True)
    sdc = dataclasses.replace(
        models(robot)["frozen again"], effects=all_effects, friction=FRICTION, horizon=0.1
    )
    result = sdc.collide(q, v, torque)
    assert result.time[0] == 0.0 and result.time[-1] == pytest.approx(result.duration, abs=1e-15)
    assert (np.diff(result.time) > 0).all() and np.diff(result.time).max() <= sdc.step_length * (1 + 1e-9)
    np.testing.assert_allclose(result.joint_velocity[0], v[6:])
    np.testing.assert_allclose(result.joint_velocity[-1], result.velocity[6:], atol=1e-9)
    assert np.abs(np.diff(result.force)).max() < 0.15 * result.peak_force
    jumps = np.abs(np.diff(result.joint_velocity, axis=0)).max(axis=0)
    assert (jumps < 0.2 * np.ptp(result.joint_velocity, axis=0) + 1e-3).all()
    k = Kinematics(
        robot, result.configuration, result.velocity, [s.frame for s in robot.soles], "right_hand", X
    )
    assert k.j @ result.velocity == pytest.approx(result.hand_speed[-1], abs=2e-3)
    np.testing.assert_allclose(k.Jc @ result.velocity, 0.0, atol=1e-2)
    coarse = sdc.function(("time",), every=8)(q, v, torque)
    assert float(coarse[-1]) == pytest.approx(result.duration, abs=1e-12)


@pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning")
@pytest.mark.parametrize("compiled", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_histories_end_at_separation_in_whichever_segment_it_is(compiled, monkeypatch):
    """Here before the last, as the trial that divides the contact has taken it to be longer."""
    if not compiled:
        monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    robot = small()
    law, target = SpringDamper(stiffness=22609.53351130677, damping=30.0), FreeMass(mass=286.62159211331305)
    scene = {"robot": robot, "striker": "fist", "normal": X, "law": law, "target": target}
    sdc = SDC(**scene, freezes=4, accuracy=None, horizon=0.5)
    q = robot.posture("half_sitting")
    v = striking_velocity(robot, q, "fist", X, 1.0)
    hit = sdc.collide(q, 3.8987266111449332 * v, holding_torque(robot, q, v))
    assert hit.time[-1] == pytest.approx(hit.duration, rel=1e-12)
    assert hit.force[-1] == pytest.approx(0.0, abs=1e-9 * hit.peak_force)


def test_a_contact_that_is_over_early_or_not_at_all_is_the_same_with_freezes():
    robot, rungs = small(), models(small(), striker="fist")
    for speed in (-1.0, 1e-4):
        q, v, torque = situation(robot, seed=13, speed=speed, **FIST)
        once, again = (rungs[name].collide(q, v, torque) for name in ("repaired", "frozen again"))
        assert again.separated
        assert again.impulse == pytest.approx(once.impulse, rel=1e-2, abs=1e-12)
    short = dataclasses.replace(rungs["frozen again"], horizon=0.01)
    q, v, torque = situation(robot, **FIST)
    with pytest.raises(InputError, match="horizon"):
        short.collide(q, v, torque)
    assert short.collide(q, v, torque, require_separation=False).duration == pytest.approx(0.01, rel=1e-9)


# ------------------------------------------------------------ laws and targets without derivatives
def test_a_rounded_hand_on_a_wall():
    robot, law = slider(3.0), HuntCrossley(stiffness=1e6, dissipation=0.2)
    given = {"robot": robot, "striker": "tip", "normal": X, "target": RigidWall()}
    assert SDC(**given, law=SpringDamper(stiffness=1e4, damping=0.0)).stepping == "implicit"
    sdc = SDC(**given, law=law)
    assert sdc.stepping == "implicit"
    # m dv = -f dt, f = k x^(3/2) (1 + b v): impulse on a wall is the change of momentum
    result = sdc.collide([0.0], [1.0], [0.0])
    assert result.impulse == pytest.approx(3.0 * (1.0 - result.hand_speed[-1]), rel=1e-9)
    assert result.energy == 0.0 and result.target_result == {}


# ------------------------------------------------------------ gains as matrices
@pytest.mark.slow
def test_matrices_of_gains_are_those_of_the_joints_if_diagonal_and_couple_joints_if_not():
    robot = small()
    q, v, torque = situation(robot, seed=4, speed=1.0, **FIST)
    by_joint = models(robot, striker="fist")["repaired"].collide(q, v, torque)
    diagonal = models(robot, striker="fist")["repaired"]
    diagonal = dataclasses.replace(diagonal, kp=np.diag(robot.kp), kd=np.diag(robot.kd))
    assert diagonal.collide(q, v, torque).impulse == pytest.approx(by_joint.impulse, rel=1e-12)
    rng = np.random.default_rng(0)
    root = np.sqrt(robot.kd)
    coupling = np.eye(robot.n) + 2.0 * (lambda m: m @ m.T / robot.n)(rng.normal(size=(robot.n, robot.n)))
    kd = root[:, None] * coupling * root
    options = {"robot": robot, "striker": "fist", "normal": X, "law": LAW, "target": TARGET, "kd": kd}
    coupled, full = SDC(**options, freezes=8), FullDynamics(**options)
    found = coupled.collide(q, v, torque)
    assert found.impulse == pytest.approx(full.collide(q, v, torque).impulse, rel=1e-4)
    assert abs(found.impulse / by_joint.impulse - 1.0) > 1e-3
    u = found.joint_velocity - v[6:]
    assert np.abs(found.demand[1] - torque + kd @ u[1]).max() < 1.0
    for bad, message in (
        (-np.eye(robot.n), "kd: not positive semidefinite"),
        (np.ones((robot.n, 2)), "kd: expected shape"),
        (np.full(robot.n, np.nan), "kd: nan"),
        (-1.0, "kd: has -1"),
    ):
        with pytest.raises(InputError, match=message):
            SDC(**{**options, "kd": bad})


# ------------------------------------------------------------ a hand that supports
@pytest.mark.slow
def test_a_held_hand_stays_and_bears_what_the_ground_does_not():
    robot = inside_the_hand()
    stance = BothSoles(hands=("left_hand",))
    frames = stance.constraint_frames(robot)
    assert frames == (*stance.sole_frames(robot), robot.striker("left_hand").model_frame)
    q, v, torque = situation(robot, seed=5)
    k = Kinematics(robot, q, v, frames, "right_hand", X)
    rows = np.vstack([k.Jc, k.j])
    v = v - np.linalg.pinv(rows) @ (rows @ v - np.append(np.zeros(18), 1.0))
    rungs = models(robot, stance=stance)
    result, full = rungs["repaired"].collide(q, v, torque), rungs["full"].collide(q, v, torque)
    assert result.hand_wrench.shape == (len(result.time), 1, 6)
    assert result.impulse == pytest.approx(full.impulse, rel=0.05)
    np.testing.assert_allclose(result.hand_wrench[0], full.hand_wrench[0], atol=2.0)
    k = Kinematics(robot, q, result.velocity, frames, "right_hand", X)
    np.testing.assert_allclose(k.Jc[12:] @ result.velocity, 0.0, atol=0.02)
    # the hand is held by the world, not by the ground: it has no part in the ZMP's wrench
    np.testing.assert_allclose(
        result.ground_wrench[:, :3], result.sole_wrench[:, :, :3].sum(axis=1), atol=1e-8
    )
    free = float(effective_mass(robot, striker="right_hand", normal=X)(q))
    assert float(effective_mass(robot, striker="right_hand", normal=X, stance=stance)(q)) > free


def test_held_hands_are_checked():
    robot = robot_named("talos")
    with pytest.raises(InputError, match="hands: 'left_hand'; give a tuple"):
        BothSoles(hands="left_hand")
    with pytest.raises(InputError, match="no striker 'left_hnad'"):
        models(robot, stance=BothSoles(hands=("left_hnad",)))
    with pytest.raises(InputError, match=r"right_hand.*held"):
        models(robot, stance=BothSoles(hands=("right_hand",)))
    with pytest.raises(InputError, match="no hand is held"):
        models(robot)["repaired"].function(("hand_wrench",))
    with pytest.raises(InputError, match="give the limits of its grip"):
        ImpactProblem(
            robot=robot,
            striker="right_hand",
            point=[0.5, -0.2, 1.1],
            normal=X,
            target=FreeMass(mass=5.0),
            law=LAW,
            stance=BothSoles(hands=("left_hand",)),
        )


@pytest.mark.parametrize("freezes", [-1, 1.5])
def test_freezes_are_a_whole_number(freezes):
    with pytest.raises(InputError, match="freezes"):
        SDC(robot=slider(1.0), striker="tip", normal=X, law=LAW, target=TARGET, freezes=freezes)


def test_freezes_may_be_an_integer_of_numpy():
    given = np.arange(3)[2]
    model = SDC(robot=slider(1.0), striker="tip", normal=X, law=LAW, target=TARGET, freezes=given)
    assert model.freezes == 2


# ------------------------------------------------------------ moving a configuration
@pytest.mark.parametrize("scale", [1.0, 1e-2, 9e-4, 1e-5, 0.0])
def test_integrate_moves_as_pinocchio_does(scale):
    import casadi as ca

    robot = robot_named("talos")
    rb = RigidBody(robot.model)
    d = ca.SX.sym("d", robot.nv)
    move = ca.Function("move", [rb.q, d], [rb.integrate(d)])
    rng = np.random.default_rng(int(1e6 * scale))
    q = pin.integrate(robot.model, robot.posture("half_sitting"), rng.normal(size=robot.nv))
    way = scale * rng.normal(size=robot.nv)
    np.testing.assert_allclose(np.array(move(q, way)).ravel(), pin.integrate(robot.model, q, way), atol=1e-15)
