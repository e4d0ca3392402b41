"""Symbolic rigid-body functions against Pinocchio, at 100 random configurations of each robot.

Pinocchio shares no code with `impactopt.robots.rigid_body` beyond the model's numbers. Errors are relative to
the largest entry of the array compared, in the worst configuration.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from support.rigid_body_cases import (
    NAMES,
    SAMPLES,
    case,
    configurations,
    reference_derivatives,
    reference_values,
)
from support.small_robots import biped

from impactopt import Actuator, InputError, RigidBody

VALUES, DERIVATIVES = 1e-12, 1e-10


# ---------------------------------------------------------------- what is compared
class Symbols:
    """A RigidBody of a case, and a right-hand side b (nv)."""

    def __init__(self, name: str, base: str) -> None:
        self.case = case(name)
        self.rb = RigidBody(self.case.model, base=base)
        self.b = ca.SX.sym("b", self.rb.nv)

    def evaluate(self, outputs: dict[str, Any], count: int = SAMPLES) -> dict[str, np.ndarray]:
        """Every output at the random configurations, (count, rows, columns)."""
        rb = self.rb
        q, v, a, b = configurations(self.case.model, count)
        function = ca.Function("f", [rb.q, rb.v, rb.a, self.b], [ca.densify(x) for x in outputs.values()])
        ours = np.array([rb.from_pin(x) for x in q])
        results = function.map(count)(ours.T, v.T, a.T, b.T)
        results = results if isinstance(results, tuple) else (results,)
        out = {}
        for (name, x), result in zip(outputs.items(), results, strict=True):
            out[name] = np.array(result).reshape(x.size1(), count, x.size2()).transpose(1, 0, 2)
        return out


@cache
def symbols(name: str, base: str = "quaternion") -> Symbols:
    return Symbols(name, base)


def value_outputs(s: Symbols) -> dict[str, Any]:
    rb, H, factor = s.rb, s.rb.mass_matrix(), s.rb.factorize()
    out = {
        "H": H,
        "rnea": rb.rnea(rb.v, rb.a),
        "rnea without gravity": rb.rnea(rb.v, rb.a, gravity=False),
        "gravity": rb.rnea(None, None),
        "rnea at rest": rb.rnea(None, rb.a),
        "com": rb.com(),
        "A_g": rb.centroidal_map(),
        "momentum": rb.centroidal_momentum(rb.v),
        "LTDL residual": H @ factor.solve(s.b) - s.b,
    }
    for frame in s.case.frames:
        out[f"R {frame}"], out[f"p {frame}"] = rb.frame(frame)
        out[f"J {frame}"] = rb.jacobian(frame)
        out[f"velocity {frame}"] = rb.frame_velocity(frame, rb.v)
        out[f"acceleration {frame}"] = rb.frame_acceleration(frame, rb.v, rb.a)
        out[f"Jdot v {frame}"] = rb.frame_acceleration(frame, rb.v, None)
    return out


def tangent(s: Symbols, expression: Any) -> Any:
    """d expression / dq in v's basis."""
    return ca.jacobian(expression, s.rb.q) @ s.rb.tangent_map()


def derivative_outputs(s: Symbols) -> dict[str, Any]:
    rb, tau = s.rb, s.rb.rnea(s.rb.v, s.rb.a)
    tip = s.case.frames[0]
    J, A = rb.jacobian(tip), rb.centroidal_map()
    return {
        "d rnea/dq": tangent(s, tau),
        "d rnea/dv": ca.jacobian(tau, rb.v),
        "d rnea/da": ca.jacobian(tau, rb.a),
        "d(H a)/dq": tangent(s, rb.mass_matrix() @ rb.a),
        "dp/dq": tangent(s, rb.frame(tip)[1]),
        "d com/dq": tangent(s, rb.com()),
        "dJ/dt v": ca.jtimes(J @ rb.v, rb.q, rb.tangent_map() @ rb.v),
        "dA_g/dt v": ca.jtimes(A @ rb.v, rb.q, rb.tangent_map() @ rb.v),
        "d momentum/dt": ca.jtimes(rb.centroidal_momentum(rb.v), rb.q, rb.tangent_map() @ rb.v),
        "d velocity/dt": ca.jtimes(rb.frame_velocity(tip, rb.v), rb.q, rb.tangent_map() @ rb.v),
    }


def errors(ours: dict[str, np.ndarray], references: list[dict[str, np.ndarray]]) -> dict[str, float]:
    """Worst relative error of each output; absolute where the reference is zero."""
    worst = {}
    for name in references[0]:
        want = np.reshape([reference[name] for reference in references], ours[name].shape)
        error, size = (np.abs(x).max(axis=(1, 2)) for x in (ours[name] - want, want))
        worst[name] = float((error / np.where(size > 0, size, 1.0)).max())
    return worst


# ---------------------------------------------------------------- values and first derivatives
BASES = pytest.mark.parametrize(
    ("name", "base"), [*((name, "quaternion") for name in NAMES), ("g1", "rpy"), ("tree floating 1", "rpy")]
)


@BASES
def test_values_agree_with_pinocchio(name: str, base: str) -> None:
    s = symbols(name, base)
    ours = s.evaluate(value_outputs(s))
    samples = zip(*configurations(s.case.model), strict=True)
    worst = errors(ours, [reference_values(s.case, *sample) for sample in samples])
    assert {k: e for k, e in worst.items() if not e <= VALUES} == {}


@BASES
def test_first_derivatives_agree_with_pinocchio(name: str, base: str) -> None:
    s = symbols(name, base)
    ours = s.evaluate(derivative_outputs(s))
    q, v, a, _ = configurations(s.case.model)
    samples = zip(q, v, a, strict=True)
    worst = errors(ours, [reference_derivatives(s.case, *sample) for sample in samples])
    assert {k: e for k, e in worst.items() if not e <= DERIVATIVES} == {}


@pytest.mark.parametrize("base", ["quaternion", "rpy"])
def test_springs_add_to_gravity(base: str) -> None:
    springs = {
        "left knee": Actuator(spring_stiffness=50.0, spring_rest=0.4),
        "elbow": Actuator(spring_stiffness=7.0),
    }
    robot = biped().with_actuators(springs)
    q, v, a, _ = (rows[0] for rows in configurations(robot.model, 1))
    knee, elbow = (robot.joint_index(name) for name in springs)
    angles, expected = robot.joint_positions(q), np.zeros(robot.nv)
    expected[6 + knee], expected[6 + elbow] = 50.0 * (angles[knee] - 0.4), 7.0 * angles[elbow]
    data = robot.model.createData()
    np.testing.assert_allclose(
        robot.inverse_dynamics(data, q, v, a) - pin.rnea(robot.model, data, q, v, a), expected, atol=1e-9
    )
    np.testing.assert_allclose(
        robot.generalized_gravity(data, q) - pin.computeGeneralizedGravity(robot.model, data, q),
        expected,
        atol=1e-9,
    )
    rb = RigidBody(robot.model, base, springs=robot.springs)
    for gravity in (True, False):
        ours = ca.Function("f", [rb.q, rb.v, rb.a], [rb.rnea(rb.v, rb.a, gravity=gravity)])
        plain = RigidBody(robot.model, base)
        other = ca.Function("f", [plain.q, plain.v, plain.a], [plain.rnea(plain.v, plain.a, gravity=gravity)])
        added = np.ravel((ours(rb.from_pin(q), v, a) - other(rb.from_pin(q), v, a)).full())
        np.testing.assert_allclose(added, expected * gravity, atol=1e-9)


# ---------------------------------------------------------------- factorization
@pytest.mark.parametrize("name", NAMES)
def test_factor_solves_with_the_mass_matrix(name: str) -> None:
    s = symbols(name)
    rb = s.rb
    H, J = rb.mass_matrix(), rb.jacobian(s.case.frames[0])
    plain, given = rb.factorize(), rb.factorize(2.0 * H + ca.diag(s.b**2))
    ours = s.evaluate(
        {
            "H": H,
            "J": J,
            "b": s.b,
            "solve": plain.solve(s.b),
            "solve many": plain.solve(J.T),
            "half": ca.diag(1.0 / ca.sqrt(ca.densify(plain.diagonal))) @ plain.half_solve(J.T),
            "given": given.solve(s.b),
        }
    )
    for k in range(SAMPLES):
        o = {key: x[k] for key, x in ours.items()}
        H_, J_, b = o["H"], o["J"], o["b"]
        matrices = {
            "solve": (H_, b),
            "solve many": (H_, J_.T),
            "given": (2.0 * H_ + np.diag(b[:, 0] ** 2), b),
        }
        for key, (matrix, right) in matrices.items():
            # Rounding's share in any solution grows with the matrix's condition: judge by the residual.
            size = np.abs(matrix).max() * np.abs(o[key]).max() + np.abs(right).max()
            assert np.abs(matrix @ o[key] - right).max() <= VALUES * size, key
        tolerance = max(VALUES, 4.0 * np.finfo(float).eps * np.linalg.cond(H_))
        form = J_ @ np.linalg.solve(H_, J_.T)
        np.testing.assert_allclose(
            o["half"].T @ o["half"], form, rtol=0.0, atol=tolerance * np.abs(form).max()
        )


def test_factor_has_no_fill_in() -> None:
    """A unit right-hand side of one joint reaches its ancestors only, in half a solve."""
    rb = symbols("tree fixed 3").rb
    pattern = np.array(ca.DM(rb.mass_matrix().sparsity(), 1.0)) != 0
    half = np.array(ca.DM(rb.factorize().half_solve(ca.DM.eye(rb.nv)).sparsity(), 1.0)) != 0
    assert np.array_equal(half, np.triu(pattern))
    assert not pattern.all()


def test_a_matrix_that_couples_branches_of_the_tree_is_factorized_too() -> None:
    rb = symbols("tree fixed 3").rb
    H = np.ones((rb.nv, rb.nv)) + np.diag(np.arange(1.0, rb.nv + 1))
    inverse = ca.DM(rb.factorize(H).solve(ca.SX.eye(rb.nv)))
    np.testing.assert_allclose(inverse, np.linalg.inv(H), atol=1e-12)


def test_factor_refuses_other_shapes() -> None:
    rb = symbols("g1").rb
    with pytest.raises(InputError, match=r"H: expected shape \(35, 35\)"):
        rb.factorize(ca.SX.eye(3))
    with pytest.raises(InputError, match="b: expected 35 rows"):
        rb.factorize().solve(ca.SX.ones(4))


# ---------------------------------------------------------------- coordinates
@pytest.mark.parametrize("name", NAMES)
def test_tangent_map_is_pinocchios(name: str) -> None:
    s = symbols(name)
    ours = s.evaluate({"map": s.rb.tangent_map()})["map"]
    for q, G in zip(configurations(s.case.model)[0], ours, strict=True):
        np.testing.assert_allclose(G, pin.tangentMap(s.case.model, q), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("name", ["talos", "tree floating 1", "tree fixed 3"])
def test_coordinates_go_there_and_back(name: str) -> None:
    model = case(name).model
    for q in configurations(model)[0]:
        for base in ("quaternion", "rpy"):
            rb = symbols(name, base).rb
            ours = rb.from_pin(q)
            assert ours.shape == (rb.nq,)
            assert np.abs(pin.difference(model, rb.to_pin(ours), q)).max() < 1e-12
            np.testing.assert_allclose(rb.from_pin(rb.to_pin(ours)), ours, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", ["talos", "tree floating 1", "tree floating 2", "tree fixed 3"])
def test_rpy_velocity_and_acceleration(name: str) -> None:
    """v = T dq/dt moves frames as their own derivative in q does, and a is its derivative in time."""
    s = symbols(name, "rpy")
    rb, tip = s.rb, s.case.frames[0]
    rate, second = rb.v, rb.a  # stand for dq/dt and d2q/dt2 here
    v, a = rb.velocity_map() @ rate, rb.acceleration(rate, second)
    R, p = rb.frame(tip)
    dR = ca.reshape(ca.jtimes(ca.vec(R), rb.q, rate), 3, 3)
    velocity, acceleration = rb.frame_velocity(tip, v), rb.frame_acceleration(tip, v, a)
    out = s.evaluate(
        {
            "identity": rb.velocity_map() @ rb.tangent_map(),
            "a": a,
            "dv/dt": ca.jtimes(v, rb.q, rate) + rb.velocity_map() @ second,
            "velocity": velocity,
            "dp/dt": ca.vertcat(ca.jtimes(p, rb.q, rate), ca.inv_skew(dR @ R.T)),
            "acceleration": acceleration,
            "d2p/dt2": ca.jtimes(velocity, rb.q, rate) + ca.jtimes(velocity, rate, second),
        }
    )
    for sample in range(SAMPLES):
        o = {key: x[sample] for key, x in out.items()}
        np.testing.assert_allclose(o["identity"], np.eye(rb.nv), rtol=0.0, atol=1e-12)
        for ours, other in (("a", "dv/dt"), ("velocity", "dp/dt"), ("acceleration", "d2p/dt2")):
            want = o[other]
            np.testing.assert_allclose(o[ours], want, rtol=0.0, atol=DERIVATIVES * np.abs(want).max())


@pytest.mark.parametrize("name", ["g1", "tree floating 1", "tree fixed 3"])
def test_rpy_rates_are_pinocchios_velocity(name: str) -> None:
    """Against Pinocchio's own difference of two configurations, h apart: an error of order h^2."""
    s, h = symbols(name, "rpy"), 1e-5
    rb, model = s.rb, s.case.model
    v = s.evaluate({"v": rb.velocity_map() @ rb.v})["v"][:, :, 0]
    q, rate, _, _ = configurations(model)
    for q_k, rate_k, v_k in zip(q, rate, v, strict=True):
        ours = rb.from_pin(q_k)
        before, after = rb.to_pin(ours - h * rate_k), rb.to_pin(ours + h * rate_k)
        difference = pin.difference(model, before, after) / (2.0 * h)
        np.testing.assert_allclose(v_k, difference, rtol=0.0, atol=1e-7 * np.abs(v_k).max())


def test_velocity_map_needs_one_number_a_velocity() -> None:
    rb = symbols("g1").rb
    for call in (rb.velocity_map, lambda: rb.acceleration(rb.v, rb.a)):
        with pytest.raises(InputError, match="base='rpy'"):
            call()


# ---------------------------------------------------------------- only what is asked for is built
def test_base_pose_is_not_in_the_mass_matrix() -> None:
    rb = symbols("talos").rb
    assert not any(ca.which_depends(ca.vec(rb.mass_matrix()), rb.q[:7], 1, True))


def test_jacobian_has_columns_of_the_supporting_joints_only() -> None:
    model = case("talos").model
    J = symbols("talos").rb.jacobian("arm_right_4_link")
    support = model.supports[model.frames[model.getFrameId("arm_right_4_link")].parentJoint]
    carrying = [k for i in support if i for k in range(model.idx_vs[i], model.idx_vs[i] + model.nvs[i])]
    assert sorted(set(J.sparsity().get_col())) == carrying


def test_chains_with_the_same_velocity_are_shared() -> None:
    """Both wrists hang on the same torso, which must not be built twice."""
    model = case("talos").model

    def instructions(*frames: str) -> int:
        rb = RigidBody(model)
        v = 2.0 * rb.v
        velocities = [rb.frame_velocity(frame, v) for frame in frames]
        return int(ca.Function("f", [rb.q, rb.v], velocities).n_instructions())

    left, right = "arm_left_7_link", "arm_right_7_link"
    assert instructions(left, right) < 0.9 * (instructions(left) + instructions(right))
    assert instructions(left, left) - instructions(left) < 50


def test_structural_zeros_of_v_drop_out() -> None:
    model = case("talos").model
    rb = RigidBody(model)
    arm = ca.SX(rb.nv, 1)
    arm[-1] = rb.v[-1]
    assert rb.frame_velocity("left_sole_link", arm).is_zero()

    def instructions(v: Any) -> int:
        return int(ca.Function("f", [rb.q, rb.v], [rb.centroidal_momentum(v)]).n_instructions())

    assert instructions(arm) < 0.5 * instructions(rb.v)


# ---------------------------------------------------------------- bad input
def _one_joint(joint: Any, name: str) -> Any:
    model = pin.Model()
    model.addJoint(0, joint, pin.SE3.Identity(), name)
    return model


@pytest.mark.parametrize(
    "joint",
    [
        pin.JointModelSpherical(),
        pin.JointModelSphericalZYX(),
        pin.JointModelPlanar(),
        pin.JointModelTranslation(),
        pin.JointModelHX(0.1),
        pin.JointModelUniversal(np.array([1.0, 0, 0]), np.array([0, 1.0, 0])),
    ],
    ids=lambda joint: joint.shortname(),
)
def test_other_joint_types_are_named(joint: Any) -> None:
    with pytest.raises(InputError, match=f"joint 'shoulder': type {joint.shortname()} is not supported"):
        RigidBody(_one_joint(joint, "shoulder"))


def test_a_free_flyer_must_be_the_only_root() -> None:
    model = _one_joint(pin.JointModelRX(), "arm")
    model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "ball")
    with pytest.raises(InputError, match="free-flyer joint 'ball'"):
        RigidBody(model)


def test_armature_on_the_free_flyer_is_refused() -> None:
    model = _one_joint(pin.JointModelFreeFlyer(), "root")
    model.armature = np.full(6, 0.1)
    with pytest.raises(InputError, match="armature"):
        RigidBody(model)


def test_bad_arguments_are_named() -> None:
    rb = symbols("g1").rb
    with pytest.raises(InputError, match=r"frame 'right_wrist_yaw_lnk'.*did you mean 'right_wrist_yaw_link'"):
        rb.frame("right_wrist_yaw_lnk")
    with pytest.raises(InputError, match=r"model must be a pin\.Model, as that of a robot, not 'talos'"):
        RigidBody("talos")
    with pytest.raises(InputError, match="did you mean 'quaternion'"):
        RigidBody(rb.model, base="quaternions")
    with pytest.raises(InputError, match="v: expected a column of 35 numbers"):
        rb.rnea(rb.v[:-1], rb.a)
    with pytest.raises(InputError, match="a: expected a column of 35 numbers"):
        rb.frame_acceleration("pelvis", rb.v, rb.a.T)
    with pytest.raises(InputError, match="a: NaN"):
        rb.rnea(rb.v, np.full(35, np.nan))
    with pytest.raises(InputError, match="v: expected SX or numbers, got MX"):
        rb.rnea(ca.MX.sym("v", 35), rb.a)
    with pytest.raises(InputError, match=r"q .*shape"):
        rb.from_pin(np.zeros(3))
    with pytest.raises(InputError, match="quaternion"):
        rb.from_pin(np.zeros(rb.model.nq))
    with pytest.raises(InputError, match="nan at index 9"):
        q = pin.neutral(rb.model)
        q[9] = np.nan
        rb.from_pin(q)


def test_no_mass_has_no_centre_of_mass() -> None:
    with pytest.raises(InputError, match="no mass"):
        RigidBody(_one_joint(pin.JointModelRX(), "arm")).com()


def test_a_joint_without_inertia_cannot_be_factorized() -> None:
    model = _one_joint(pin.JointModelRX(), "arm")
    with pytest.raises(InputError, match="velocity 0 has no inertia"):
        RigidBody(model).factorize()
