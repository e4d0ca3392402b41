"""Independent coordinates: fixed soles stay in place; symbolic and numeric maps agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.small_robots import arm, biped

from impactopt import InputError, Robot, load_robot
from impactopt.kinematics.coordinates import (
    StanceCoordinates,
    base_motion,
    elimination_order,
    independent_rates,
    solve_in_order,
)
from impactopt.kinematics.inverse_kinematics import inverse_kinematics
from impactopt.kinematics.operational_space import static_wrenches

Array = NDArray[np.float64]
seeds = st.integers(0, 2**31)


@dataclass
class Case:
    """A robot on its soles and the symbolic maps of its coordinates as functions of numbers."""

    robot: Robot
    posture: Array
    c: StanceCoordinates
    motion: Any  # y, legs, yd, ydd -> v, a
    velocity: Any  # y, legs, two rates -> two v
    closure: Any  # y, legs -> closure, its Jacobian in (y, legs)
    wrenches: Any  # y, legs, w -> generalized force
    upper: Any  # y, yd, ydd -> q, v, a
    twists: Any  # y, legs, yd, leg rates -> twists of the soles


def make_case(robot: Robot, posture: str, soles: int | None = None, hands: tuple[str, ...] = ()) -> Case:
    q = robot.posture(posture)
    c = StanceCoordinates(robot, robot.soles[:soles], q, tuple(robot.striker(name) for name in hands))
    y, yd, ydd = (ca.SX.sym(s, c.ny) for s in ("y", "yd", "ydd"))
    legs, w, rates = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("rates", c.ny, 2)
    closure = c.closure(y, legs) if c.legs else ca.SX(0, 1)
    leg_rates = ca.SX.sym("leg_rates", c.nl)
    twists = c.sole_twists(y, legs, yd, leg_rates) if c.legs else ca.SX(0, 1)
    return Case(
        robot=robot,
        posture=q,
        c=c,
        motion=ca.Function("motion", [y, legs, yd, ydd], list(c.motion(y, legs, yd, ydd))),
        velocity=ca.Function("velocity", [y, legs, rates], [c.velocity(y, legs, rates)]),
        closure=ca.Function("closure", [y, legs], [closure, ca.jacobian(closure, ca.vertcat(y, legs))]),
        wrenches=ca.Function("wrenches", [y, legs, w], [c.sole_wrench_map(y, legs, w)]),
        upper=ca.Function("upper", [y, yd, ydd], list(c.upper_motion(y, yd, ydd))),
        twists=ca.Function("twists", [y, legs, yd, leg_rates], [twists]),
    )


HIPS = {f"{side} hip pitch": (f"{side} hip tilt", 2.0, -0.4) for side in ("left", "right")}
YAW = {"right hip yaw": ("left hip yaw", -1.0, 0.0)}
CASES = {
    "talos": lambda: make_case(load_robot("talos"), "half_sitting"),
    "g1": lambda: make_case(load_robot("g1"), "half_sitting"),
    "biped": lambda: make_case(biped(), "half_sitting"),
    "biped on its left foot": lambda: make_case(biped(), "half_sitting", 1),
    "biped on legs of seven": lambda: make_case(biped(7), "half_sitting"),
    "biped with a waist": lambda: make_case(biped(waist=True), "half_sitting"),
    "biped on hinged soles": lambda: make_case(biped(5), "half_sitting"),
    "biped whose hips follow": lambda: make_case(biped(7, followers=HIPS), "half_sitting"),
    "biped on its left foot, with one hip motor": lambda: make_case(biped(followers=YAW), "half_sitting", 1),
    "stand-in that holds on": lambda: make_case(load_robot("standin"), "half_sitting", hands=("left_hand",)),
    "arm": lambda: make_case(arm(), "start"),
}
FLOATING = [name for name in CASES if name != "arm"]
_made: dict[str, Case] = {}


def made(name: str) -> Case:
    if name not in _made:
        _made[name] = CASES[name]()
    return _made[name]


@pytest.fixture(params=list(CASES))
def case(request: pytest.FixtureRequest) -> Case:
    return made(request.param)


@pytest.fixture(params=FLOATING)
def standing(request: pytest.FixtureRequest) -> Case:
    return made(request.param)


def random_state(case: Case, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """y near the posture with the legs that close it, and rates of order one."""
    c = case.c
    y, legs = c.split(case.posture)
    y[c.base :] += rng.uniform(-0.5, 0.5, c.ny - c.base)
    if c.base:
        y[:6] += np.array([0.03, 0.03, 0.02, 0.08, 0.08, 0.08]) * rng.uniform(-1, 1, 6) - [
            0,
            0,
            0.03,
            0,
            0,
            0,
        ]
        legs = c.solve_legs(y, legs)
    yd, ydd = rng.standard_normal((2, c.ny)) * np.array([0.5] * c.base + [2.0] * (c.ny - c.base))
    return y, legs, yd, 5 * ydd


def column(value: Any) -> Array:
    return np.array(value).ravel()


# ---- numbers and names


def test_legs_that_share_a_motor_hold_one_sole_and_not_two() -> None:
    with pytest.raises(InputError, match=r"legs share joints: .*left hip yaw also move another fixed sole"):
        make_case(biped(followers=YAW), "half_sitting")


def test_coordinates_are_the_base_and_the_joints_outside_the_legs(case: Case) -> None:
    c, robot = case.c, case.robot
    assert c.ny + c.nl == robot.nv
    assert len(c.labels) == c.ny
    assert c.nl == 6 * len(c.legs)
    assert sorted([*c.labels[c.base :], *c.leg_labels]) == sorted(robot.joint_names)
    held = {j for leg in c.legs for j in robot.limb(leg.frame)[-6:]}  # of an arm, without the waist
    assert held == set(c.dependent.tolist())
    assert held.isdisjoint(c.independent.tolist())


def test_split_and_join_are_inverse(case: Case) -> None:
    c, rng = case.c, np.random.default_rng(0)
    for _ in range(5):
        y, legs, _, _ = random_state(case, rng)
        q = c.join(y, legs)
        assert pin.isNormalized(case.robot.model, q, 1e-12)
        back_y, back_legs = c.split(q)
        np.testing.assert_allclose(back_y, y, atol=1e-12)
        np.testing.assert_allclose(back_legs, legs, atol=1e-12)
        np.testing.assert_allclose(c.join(back_y, back_legs), q, atol=1e-12)


def test_a_base_that_faces_backwards_does_not_turn_round() -> None:
    """A yaw of pi at the start is one of -pi just beyond it: the first guess of iCub turned once."""
    robot = biped()
    for turn in (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])):
        q = robot.posture("half_sitting")
        near = [pin.Quaternion(pin.exp3((np.pi + step) * turn)).coeffs() for step in (-0.01, 0.02)]
        backwards, beyond = (np.concatenate([q[:3], base, q[7:]]) for base in near)
        c = StanceCoordinates(robot, (), backwards)
        step = c.split(beyond)[0] - c.start
        np.testing.assert_allclose(step[3:6], 0.03 * turn, atol=1e-9)


def test_a_continuous_joint_with_limits_stays_inside_them() -> None:
    robot = arm(position_limit=dict.fromkeys(("turn", "shoulder", "elbow", "wrist"), (-3.0, 3.0)))
    near, far = (robot.angles.put(np.zeros(robot.nq), np.array([x, 0.3, 0.3, 0.3])) for x in (2.9, -2.9))
    assert StanceCoordinates(robot, (), near).split(far)[0][0] == pytest.approx(-2.9)


# ---- fixed soles


def test_completed_motions_leave_the_soles_at_rest(standing: Case) -> None:
    """By Pinocchio: no velocity and acceleration of any fixed sole, and each where the posture had it."""
    c, model, rng = standing.c, standing.robot.model, np.random.default_rng(1)
    data, start = model.createData(), model.createData()
    pin.framesForwardKinematics(model, start, standing.posture)
    for _ in range(5):
        y, legs, yd, ydd = random_state(standing, rng)
        q, v, a = c.complete_motion(y, yd, ydd, legs)
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        for leg in c.legs:
            frame = model.getFrameId(leg.frame)
            np.testing.assert_allclose(data.oMf[frame].homogeneous, start.oMf[frame].homogeneous, atol=1e-10)
            for of in (pin.LOCAL, pin.LOCAL_WORLD_ALIGNED):
                assert np.abs(pin.getFrameVelocity(model, data, frame, of).vector).max() < 1e-10
            # the classical acceleration is the spatial one where the velocity is zero
            assert (
                np.abs(pin.getFrameClassicalAcceleration(model, data, frame, pin.LOCAL).vector).max() < 1e-9
            )


def test_symbolic_motion_is_the_numeric_one(case: Case) -> None:
    c, rng = case.c, np.random.default_rng(2)
    for _ in range(5):
        y, legs, yd, ydd = random_state(case, rng)
        _, v, a = c.complete_motion(y, yd, ydd, legs)
        got_v, got_a = (column(x) for x in case.motion(y, legs, yd, ydd))
        np.testing.assert_allclose(got_v, v, atol=1e-11 * np.abs(v).max())
        np.testing.assert_allclose(got_a, a, atol=1e-10 * np.abs(a).max())


def test_symbolic_velocity_takes_several_rates_at_once(case: Case) -> None:
    c, rng = case.c, np.random.default_rng(3)
    y, legs, one, two = random_state(case, rng)
    got = np.array(case.velocity(y, legs, np.stack([one, two], axis=1)))
    for k, rate in enumerate((one, two)):
        np.testing.assert_allclose(got[:, k], c.complete_motion(y, rate, 0 * rate, legs)[1], atol=1e-10)


def test_velocities_and_accelerations_are_the_derivatives_of_a_path(case: Case) -> None:
    """Along y(t), with the legs solved at every instant: v and a against differences of configurations."""
    c, model, rng = case.c, case.robot.model, np.random.default_rng(4)
    y, legs, yd, ydd = random_state(case, rng)
    h = 1e-4

    def configuration(t: float) -> Array:
        at = y + t * yd + 0.5 * t**2 * ydd
        return c.join(at, c.solve_legs(at, legs))

    def rate(t: float) -> Array:
        return np.array(pin.difference(model, configuration(t - h), configuration(t + h))) / (2 * h)

    _, v, a = c.complete_motion(y, yd, ydd, legs)
    np.testing.assert_allclose(rate(0.0), v, atol=1e-5 * np.abs(v).max())
    # pin's velocity is in the base's frame, so its derivative is what pin calls the acceleration
    np.testing.assert_allclose((rate(h) - rate(-h)) / (2 * h), a, atol=1e-4 * np.abs(a).max())


def test_the_base_map_is_the_derivative_of_its_pose() -> None:
    rng = np.random.default_rng(5)
    y, yd, ydd = 0.5 * rng.standard_normal((3, 6))
    h = 1e-4

    def pose(t: float) -> Any:
        at = y + t * yd + 0.5 * t**2 * ydd
        return pin.SE3(pin.rpy.rpyToMatrix(at[3:]), at[:3])

    def twist(t: float) -> Array:
        return np.array(pin.log6(pose(t - h).actInv(pose(t + h))).vector) / (2 * h)

    v, a = base_motion(y, yd, ydd)
    np.testing.assert_allclose(twist(0), v, atol=1e-7)
    np.testing.assert_allclose((twist(h) - twist(-h)) / (2 * h), a, atol=1e-5)


def test_closure_is_zero_on_closed_legs_and_its_derivative_is_right(standing: Case) -> None:
    c, rng = standing.c, np.random.default_rng(6)
    y, legs, _, _ = random_state(standing, rng)
    assert np.abs(column(standing.closure(y, legs)[0])).max() < 1e-10
    off = legs + 0.05 * rng.standard_normal(c.nl)
    value, jac = (np.array(x) for x in standing.closure(y, off))
    assert np.abs(value).max() > 1e-3
    for _ in range(4):
        dy, dl, h = rng.standard_normal(c.ny), rng.standard_normal(c.nl), 1e-5
        ends = [column(standing.closure(y + s * h * dy, off + s * h * dl)[0]) for s in (1, -1)]
        np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), jac @ np.concatenate([dy, dl]), atol=1e-7)


def test_closure_is_the_sole_error_in_metres_and_radians(standing: Case) -> None:
    c, model, rng = standing.c, standing.robot.model, np.random.default_rng(7)
    y, legs, _, _ = random_state(standing, rng)
    off = legs + 1e-3 * rng.standard_normal(c.nl)
    got = column(standing.closure(y, off)[0]).reshape(-1, 6)
    data = model.createData()
    pin.framesForwardKinematics(model, data, c.join(y, off))
    for value, leg in zip(got, c.legs, strict=True):
        place = data.oMf[model.getFrameId(leg.frame)]
        np.testing.assert_allclose(value[:3], place.translation - leg.placement.translation, atol=1e-12)
        turn = pin.log3(place.rotation @ leg.placement.rotation.T)
        np.testing.assert_allclose(value[3:], turn, atol=1e-3 * np.abs(turn).max())


def test_sole_twists_are_pinocchios_in_the_axes_of_the_base(standing: Case) -> None:
    """For any leg rates; for the right ones they are zero."""
    c, model, rng = standing.c, standing.robot.model, np.random.default_rng(12)
    data = model.createData()
    y, legs, yd, _ = random_state(standing, rng)
    q, v, _ = c.complete_motion(y, yd, 0 * yd, legs)
    columns = c.base + c.dependent
    np.testing.assert_allclose(column(standing.twists(y, legs, yd, v[columns])), 0, atol=1e-10)
    v[columns] += rng.standard_normal(c.nl)
    got = column(standing.twists(y, legs, yd, v[columns])).reshape(-1, 6)
    pin.forwardKinematics(model, data, q, v)
    pin.updateFramePlacements(model, data)
    base = data.oMi[1].rotation
    for twist, leg in zip(got, c.legs, strict=True):
        frame = model.getFrameId(leg.frame)
        wanted = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(base @ twist[:3], wanted.linear, atol=1e-10)
        np.testing.assert_allclose(base @ twist[3:], wanted.angular, atol=1e-10)


def test_the_wrench_map_is_the_soles_jacobians_transposed(standing: Case) -> None:
    """The wrench is in the sole's own frame: its generalized force is J_local^T w, wherever the base is."""
    c, model, rng = standing.c, standing.robot.model, np.random.default_rng(8)
    y, legs, _, _ = random_state(standing, rng)
    w = rng.standard_normal(6 * len(c.legs)) * 100
    q = c.join(y, legs)
    data = model.createData()
    wanted = np.zeros(model.nv)
    for k, leg in enumerate(c.legs):
        jac = pin.computeFrameJacobian(model, data, q, model.getFrameId(leg.frame), pin.LOCAL)
        wanted += jac.T @ w[6 * k : 6 * k + 6]
    np.testing.assert_allclose(column(standing.wrenches(y, legs, w)), wanted, atol=1e-10)
    jac, places = c.sole_jacobians(q)
    np.testing.assert_allclose(jac.T @ w, wanted, atol=1e-10)
    for place, leg in zip(places, c.legs, strict=True):
        np.testing.assert_allclose(place.homogeneous, leg.placement.homogeneous, atol=1e-10)


def test_upper_motion_is_the_motion_without_the_legs(case: Case) -> None:
    c, rng = case.c, np.random.default_rng(9)
    y, legs, yd, ydd = random_state(case, rng)
    q, v, a = (column(x) for x in case.upper(y, yd, ydd))
    full_q = c.rb.from_pin(c.join(y, legs))
    _, full_v, full_a = c.complete_motion(y, yd, ydd, legs)
    leg_rows = c.base + c.dependent
    rest = np.setdiff1d(np.arange(len(full_v)), leg_rows)
    for got, wanted in ((q, full_q), (v, full_v), (a, full_a)):
        np.testing.assert_allclose(got[rest], wanted[rest], atol=1e-10)
        np.testing.assert_array_equal(got[leg_rows], 0)


# ---- solving the legs


def test_legs_are_solved_from_a_poor_guess(standing: Case) -> None:
    c, rng = standing.c, np.random.default_rng(10)
    y, legs, _, _ = random_state(standing, rng)
    found = c.solve_legs(y, legs + 0.1 * rng.standard_normal(c.nl))
    np.testing.assert_allclose(found, legs, atol=1e-9)


def test_a_base_out_of_the_legs_reach_is_an_input_error(standing: Case) -> None:
    y, legs = standing.c.split(standing.posture)
    y[2] += 1.0
    with pytest.raises(InputError, match="out of the legs' reach"):
        standing.c.solve_legs(y, legs)


# ---- elimination


@given(seeds, st.integers(1, 7), st.integers(1, 3))
@settings(max_examples=40, deadline=None)
def test_elimination_in_the_found_order_is_a_solve(seed: int, n: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    # entries that are structurally zero, and a diagonal that is nowhere to be relied on
    mask = (rng.uniform(size=(n, n)) < 0.5) | np.eye(n, dtype=bool)[rng.permutation(n)]
    a, b = np.where(mask, rng.standard_normal((n, n)), 0.0), rng.standard_normal((n, columns))
    if np.linalg.cond(a) > 1e6:
        return
    order = elimination_order([a, a * (1 + 0.01 * rng.standard_normal((n, n)))])
    for part in order:
        assert sorted(part.tolist()) == list(range(n))
    sparse = ca.sparsify(ca.DM(a))
    symbol, rhs = ca.SX.sym("a", sparse.sparsity()), ca.SX.sym("b", n, columns)
    f = ca.Function("solve", [symbol, rhs], [solve_in_order(symbol, rhs, order)[0]])
    got = np.array(f(sparse, b))
    np.testing.assert_allclose(got, np.linalg.solve(a, b), rtol=1e-7, atol=1e-8 * np.abs(got).max())


def test_the_order_pivots_on_what_is_large_in_every_sample() -> None:
    """Neither sample can be eliminated from its own largest entry: it is zero in the other one."""
    one = np.array([[5.0, 1.0], [1.0, 0.0]])
    two = np.array([[0.0, 1.0], [1.0, 5.0]])
    rows, cols = elimination_order([one, two])
    assert one[rows[0], cols[0]] == 1.0
    assert two[rows[0], cols[0]] == 1.0


# ---- free-floating robots


def test_without_a_sole_all_joints_are_coordinates() -> None:
    robot = biped()
    c = StanceCoordinates(robot, (), robot.posture("half_sitting"))
    assert c.drifts and c.ny == robot.nv and c.nl == 0
    rng = np.random.default_rng(0)
    y = c.start + 0.1 * rng.standard_normal(c.ny)
    np.testing.assert_allclose(c.split(c.join(y, np.zeros(0)))[0], y, atol=1e-12)
    rates = rng.standard_normal(c.ny)
    v = c.complete_motion(y, rates, np.zeros(c.ny), np.zeros(0))[1]
    np.testing.assert_allclose(independent_rates(c, y, v), rates, atol=1e-12)


# ---- robots that cannot stand


def reduced(*joints: str, waist: bool = False) -> Robot:
    """The biped without some joints."""
    full = biped(waist=waist)
    locked = [full.model.getJointId(name) for name in joints]
    model = pin.buildReducedModel(full.model, locked, full.posture("half_sitting"))
    n = full.n - len(joints)
    limits = {"torque_limit": 100.0, "velocity_limit": 5.0, "position_limit": np.tile([-2.0, 2.0], (n, 1))}
    return Robot.from_model(model, soles=full.soles, postures={"zero": {}}, **limits)


def test_a_leg_with_too_few_joints_is_an_input_error() -> None:
    for robot, told in (
        (biped(5, hinge=None), r"sole 'left' has 5 joints.*left knee.*hinge = \"x\""),
        (
            reduced("left ankle roll", "left hip yaw"),
            r"sole 'left' has 4 joints.*needs 6 or more, or 5 and a",
        ),
        (reduced("left ankle roll", waist=True), r"of the last 6 before sole 'left', waist pitch also move"),
    ):
        with pytest.raises(InputError, match=told):
            StanceCoordinates(robot, robot.soles, next(iter(robot.postures.values())))


def test_held_legs_share_no_joint() -> None:
    robot = biped()
    with pytest.raises(InputError, match="share joints"):
        StanceCoordinates(robot, (robot.soles[0], robot.soles[0]), robot.posture("half_sitting"))


def test_a_hinge_turns_about_an_axis_that_the_leg_lacks() -> None:
    robot = biped(5, hinge="y")
    with pytest.raises(
        InputError, match="'left' cannot be fixed: joints of its leg turn it about the axis y"
    ):
        StanceCoordinates(robot, robot.soles, robot.posture("half_sitting"))


def test_a_sole_on_a_hinge_is_not_lifted() -> None:
    robot = biped(5)
    with pytest.raises(InputError, match=r"'right' turns on a hinge .* stand on both"):
        StanceCoordinates(robot, robot.soles[:1], robot.posture("half_sitting"))


# ---- statics and reach, which stand on the coordinates


def test_hinges_carry_no_torque_at_rest() -> None:
    c = (case := made("biped on hinged soles")).c
    y, legs = c.split(case.posture)
    w = static_wrenches(c, y, legs)
    jac, _ = c.sole_jacobians(case.posture)
    tau = np.array(pin.computeGeneralizedGravity(c.model, c.data, case.posture)) - jac.T @ w
    assert np.abs(tau[c.undriven]).max() < 1e-9 and len(c.undriven) == 8
    # the hinge is on the sole's own x, and half of a foot hangs on it
    assert np.abs(w[[3, 9]]).max() < 0.5 and min(w[[2, 8]]) > 100


def test_static_wrenches_carry_the_robot(standing: Case) -> None:
    c, model, rng = standing.c, standing.robot.model, np.random.default_rng(11)
    y, legs, _, _ = random_state(standing, rng)
    w = static_wrenches(c, y, legs)
    q = c.join(y, legs)
    tau = pin.computeGeneralizedGravity(model, model.createData(), q) - c.sole_jacobians(q)[0].T @ w
    np.testing.assert_allclose(tau[:6], 0, atol=1e-8)
    assert static_wrenches(made("arm").c, *made("arm").c.split(made("arm").posture)).shape == (0,)


def test_a_reached_posture_has_the_point_the_soles_and_the_limits(case: Case) -> None:
    c, robot, model = case.c, case.robot, case.robot.model
    striker = next(iter(robot.strikers))
    frame = model.getFrameId(f"striker:{striker}")
    data = model.createData()
    pin.framesForwardKinematics(model, data, case.posture)
    away = np.array([0.05, 0.04, 0.06]) if c.base else np.array([0.1, -0.2, 0.1])
    point = data.oMf[frame].translation + away
    q = inverse_kinematics(c, striker, point, case.posture)
    pin.framesForwardKinematics(model, data, q)
    np.testing.assert_allclose(data.oMf[frame].translation, point, atol=1e-7)
    for leg in c.legs:
        gap = leg.placement.actInv(data.oMf[model.getFrameId(leg.frame)])
        assert np.abs(pin.log6(gap).vector).max() < 1e-7
    angles = robot.joint_positions(q)
    margin = np.where(robot.hinges, 0.00125, 0.02)  # a quarter of a hinge's range
    assert (angles >= robot.lower + margin - 1e-9).all()
    assert (angles <= robot.upper - margin + 1e-9).all()
    found = q.copy()
    q[:] = 0.0  # a caller's own: the next one gets what was found
    np.testing.assert_array_equal(inverse_kinematics(c, striker, point, case.posture), found)


def test_reach_keeps_away_from_limits_where_it_could_stay() -> None:
    """From a posture at a limit, to a point near by: the joint is moved inside."""
    case = made("biped")
    robot, q = case.robot, case.posture.copy()
    elbow = robot.joint_index("elbow")
    q[7 + elbow] = robot.upper[elbow] - 0.01
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    point = data.oMf[robot.model.getFrameId("striker:fist")].translation + 0.01
    for options, margin in (({}, 0.02), ({"margin": 0.1}, 0.1)):
        found = inverse_kinematics(case.c, "fist", point, q, **options)
        assert robot.joint_positions(found)[elbow] <= robot.upper[elbow] - margin + 1e-9


def test_reach_turns_a_continuous_joint_past_half_a_turn() -> None:
    """The arm's first joint has no limits, and two numbers in q."""
    robot = arm(postures={"start": {"turn": 2.9, "shoulder": 0.3, "elbow": 1.2, "wrist": 0.3}})
    c = StanceCoordinates(robot, (), robot.posture("start"))
    data = robot.model.createData()
    behind = robot.posture("start")
    behind[:2] = np.cos(-2.9), np.sin(-2.9)
    pin.framesForwardKinematics(robot.model, data, behind)
    point = data.oMf[robot.model.getFrameId("striker:hand")].translation
    q = inverse_kinematics(c, "hand", point, robot.posture("start"))
    assert pin.isNormalized(robot.model, q, 1e-9)
    assert robot.joint_positions(q)[0] == pytest.approx(-2.9, abs=1e-6)


@pytest.mark.parametrize("name", ["planar_arm", "arm7"])
def test_a_reach_turns_the_hand(name: str) -> None:
    """As asked where joints allow; else as nearly as may be, with the point met all the same."""
    robot = load_robot(name)
    c, posture = StanceCoordinates(robot, (), robot.posture("ready")), robot.posture("ready")
    frame, data = robot.model.getFrameId("striker:hammer"), robot.model.createData()
    face, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])
    point = np.array([0.7, 0.0, 0.75]) if name == "planar_arm" else np.array([0.65, 0.0, 0.4])
    along = []
    for facing in (None, (face, down)):
        q = inverse_kinematics(c, "hammer", point, posture, facing=facing)
        pin.framesForwardKinematics(robot.model, data, q)
        np.testing.assert_allclose(data.oMf[frame].translation, point, atol=1e-7)
        along.append(float(down @ data.oMf[frame].rotation @ face))
        assert (robot.joint_positions(q) <= robot.upper - 0.02 + 1e-9).all()
    assert along[0] < 0.96 and along[1] > along[0] + 0.05
    if name == "planar_arm":
        assert along[1] == pytest.approx(1.0, abs=1e-6)


def test_out_of_reach_says_how_far_off() -> None:
    case = made("arm")
    with pytest.raises(InputError, match=r"out of reach of 'hand': .*off by .*starts at"):
        inverse_kinematics(case.c, "hand", np.array([2.0, 0.0, 0.5]), case.posture)


def test_out_of_reach_names_the_point_that_is_reached() -> None:
    """Beside a planar arm's plane that is its foot there: no smaller distance ahead would do."""
    robot = load_robot("planar_arm")
    c, posture = StanceCoordinates(robot, (), robot.posture("ready")), robot.posture("ready")
    with pytest.raises(InputError, match=r"off by 0.05 m, with the striking point at \[0.7, 0.0, 0.75\] m"):
        inverse_kinematics(c, "hammer", np.array([0.7, 0.05, 0.75]), posture)


def test_out_of_reach_is_a_distance_and_not_its_largest_component() -> None:
    robot = load_robot("planar_arm")  # its shoulder is at 0.6 m
    c, posture = StanceCoordinates(robot, (), robot.posture("ready")), robot.posture("ready")
    reach = 0.4 + 0.36 + np.hypot(0.05, 0.33)
    point = np.array([0.0, 0.0, 0.6]) + (reach + 0.5) * np.array([0.6, 0.0, 0.8])
    with pytest.raises(InputError) as error:
        inverse_kinematics(c, "hammer", point, posture)
    off = float(str(error.value).partition("off by ")[2].split(" m")[0])
    assert off == pytest.approx(0.5, abs=0.01)
