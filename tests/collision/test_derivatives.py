"""The compiled collision as a function that CasADi differentiates: by its inputs, twice, in its solvers."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from support.implicit_cases import gradient, implicit
from support.native_cases import FRICTION, situation

from impactopt import SDC, Effects, FreeMass, InputError, SpringDamper, VirtualMass
from impactopt.codegen.compiler import find_compiler
from impactopt.robots.link_tables import planar_arm

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
]

SHORT: dict[str, Any] = {"step": 2e-3, "horizon": 0.03}
# of an input's numbers: what differences go by where they are smaller
LEAST = {
    "q": 1.0,
    "v": 1.0,
    "normal": 1.0,
    "feedforward": 10.0,
    "reference": 100.0,
    "viscous": 10.0,
    "coulomb": 10.0,
}
CASES: dict[str, tuple[str, dict[str, Any], tuple[str, ...]]] = {
    "tangents": ("arm", {}, ("impulse", "torque", "velocity", "separated")),
    "an adjoint": ("arm", {}, ("impulse",)),
    "friction": ("arm", {"effects": Effects(friction=True), "friction": FRICTION}, ("impulse", "duration")),
    "three freezes": ("arm", {"freezes": 3}, ("impulse", "demand", "separated")),
    "Runge-Kutta": ("arm", {"method": "rk4", "step": 1e-4}, ("impulse", "configuration")),
    "a point mass": ("arm", {"kind": VirtualMass}, ("impulse", "force")),
    "a biped": ("biped", {}, ("zmp", "torque")),
}


def model_of(case: str, **options: Any) -> tuple[Any, list[Any], tuple[str, ...]]:
    name, own, outputs = CASES[case]
    model = implicit(name, **{**SHORT, **own, **options})
    return model, situation(name, model), outputs


def flat(function: Any, values: list[Any]) -> list[Any]:
    return [np.array(x).ravel(order="F") for x in function.call([ca.DM(x) for x in values])]


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow) if "biped" in case else case for case in CASES]
)
def test_the_jacobian_is_that_of_differences_by_every_input(case: str) -> None:
    """Of collisions with steps that leave out 1e-13, extrapolated: within 1e-6 of the largest derivative
    along the way, or of the output where that is larger."""
    model, values, outputs = model_of(case, tolerance=1e-7)
    parameters, robot = tuple(model.settings), model.robot
    true = model_of(case, tolerance=1e-13)[0].function(outputs, parameters=parameters)
    function = model.function(outputs, parameters=parameters)
    jacobian = function.jacobian()
    found = jacobian.call([ca.DM(x) for x in values] + [0] * len(outputs))
    blocks = {name: np.array(x) for name, x in zip(jacobian.name_out(), found, strict=True)}
    # steps of one length end in whole numbers, and must not jump
    h = 1e-6 if model.stepping == "rk4" else 1e-4
    rng, sizes = np.random.default_rng(1), [np.abs(x).max() for x in flat(function, values)]
    for k, name in enumerate(function.name_in()):
        x = np.asarray(values[k], dtype=float)
        way = rng.normal(size=x.shape) * np.maximum(np.abs(x), LEAST.get(name, 0.0))
        turn = rng.normal(size=robot.nv)

        def moved(t: float, x: Any = x, way: Any = way, turn: Any = turn, name: str = name) -> Any:
            return pin.integrate(robot.model, x, t * turn) if name == "q" else x + t * way

        def slopes(h: float, k: int = k, moved: Any = moved) -> list[Any]:
            ahead, behind = (flat(true, [*values[:k], moved(t), *values[k + 1 :]]) for t in (h, -h))
            return [(a - b) / (2 * h) for a, b in zip(ahead, behind, strict=True)]

        if name == "q":
            way = (moved(1e-6) - moved(-1e-6)) / 2e-6
        for output, size, near, far in zip(outputs, sizes, slopes(h / 2), slopes(h), strict=True):
            expected = (4 * near - far) / 3 if output != "separated" else 0.0 * near
            along = blocks[f"jac_{output}_{name}"] @ way.ravel(order="F")
            scale = max(np.abs(expected).max(), size)
            assert np.abs(along - expected).max() <= 1e-6 * scale, (output, name)


@pytest.mark.slow
def test_the_length_of_a_quaternion_does_not_count() -> None:
    model, values, outputs = model_of("a biped")
    function = model.function(outputs, by=("q", "v"))
    jacobian, stretched = function.jacobian(), values[0].copy()
    stretched[3:7] *= 1.7
    unit, long = (flat(function, [q, *values[1:3]]) for q in (values[0], stretched))
    np.testing.assert_allclose(long[0], unit[0], rtol=1e-9)
    by_unit, by_long = (np.array(jacobian(q, *values[1:3], 0, 0)[0]) for q in (values[0], stretched))
    assert np.abs(by_unit[:, 3:7] @ values[0][3:7]).max() <= 1e-12 * np.abs(by_unit).max()
    np.testing.assert_allclose(by_long[:, 3:7], by_unit[:, 3:7] / 1.7, rtol=1e-6, atol=1e-9)


def test_forward_and_reverse_within_a_larger_graph() -> None:
    model, values, outputs = model_of("tangents")
    function = model.function(outputs[:2], by=("q", "v"))
    q, v = values[:2]
    x = ca.MX.sym("x", q.size + v.size)
    out = ca.vertcat(*[ca.vec(y) for y in function(q + x[: q.size], v * (1 + x[q.size :]), values[2])])
    whole = ca.Function("whole", [x], [ca.jacobian(out, x)])(0).full()
    way, weights = np.random.default_rng(2).normal(size=x.numel()), np.linspace(-1, 1, out.numel())
    forward = ca.Function("forward", [x], [ca.jtimes(out, x, way)])(0).full().ravel()
    reverse = ca.Function("reverse", [x], [ca.jtimes(out, x, weights, True)])(0).full().ravel()
    np.testing.assert_allclose(forward, whole @ way, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(reverse, whole.T @ weights, rtol=1e-10, atol=1e-12)
    q_blocks, v_blocks = (np.array(b) for b in function.jacobian()(*values[:3], 0, 0)[:2])
    np.testing.assert_allclose(whole[0, : q.size], q_blocks[0], rtol=1e-12)
    np.testing.assert_allclose(whole[0, q.size :], v_blocks[0] * v, rtol=1e-12)


@pytest.mark.parametrize("freezes", [0, 2])
def test_second_derivatives_are_those_of_the_gradient(freezes: int) -> None:
    model, values, _ = model_of("an adjoint", freezes=freezes)
    function, v = model.function(("impulse",), by=("v",)), ca.MX.sym("v", model.robot.nv)
    hessian, gradient = ca.hessian(function(values[0], v, values[2]), v)
    found = ca.Function("hessian", [v], [hessian])(values[1]).full()
    slope, h = ca.Function("gradient", [v], [gradient]), 1e-3
    expected = np.hstack(
        [
            (slope(values[1] + h * e) - slope(values[1] - h * e)).full() / (2 * h)
            for e in np.eye(model.robot.nv)
        ]
    )
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


def test_nothing_is_compiled_before_a_derivative_is_evaluated() -> None:
    said: list[str] = []
    model, values, _ = model_of("tangents", report=said.append, horizon=0.0301)
    function = model.function(("peak_force", "energy"))
    function.call([ca.DM(x) for x in values[:3]])
    jacobian = function.jacobian()
    told = len(said)
    jacobian.call([ca.DM(x) for x in values[:3]] + [0, 0])
    assert not any("jacobian" in line for line in said[:told])
    assert set(model._functions) >= {("collision", "peak_force", "energy", 1)}
    del model
    assert np.isfinite(np.array(function.jacobian().call([ca.DM(x) for x in values[:3]] + [0, 0])[0])).all()


def test_models_with_other_numbers_do_not_meet() -> None:
    """Their compiled functions are the same."""
    first, values, outputs = model_of("tangents")
    soft = model_of("tangents", law=SpringDamper(stiffness=2e3, damping=20.0), kd=3.0)[0]
    found = [model.function(outputs[:1]).jacobian()(*values[:3], 0) for model in (first, soft, first)]
    for blocks, model in zip(found, (first, soft, first), strict=True):
        settings = list(model.settings.values())
        by_v = gradient(model, "impulse", [*values[:3], *settings])[2]
        np.testing.assert_allclose(np.array(blocks[1]).ravel(), by_v, rtol=1e-5)


def test_derivatives_are_by_what_is_asked() -> None:
    model, _, outputs = model_of("tangents")
    jacobian = model.function(outputs, by=("v",)).jacobian()
    assert jacobian.nnz_out("jac_impulse_q") == 0
    assert jacobian.nnz_out("jac_impulse_v") == model.robot.nv
    with pytest.raises(InputError, match="contact_stiffness"):
        model.function(outputs, by=("contact_stiffness",))


@pytest.mark.parametrize(
    ("solver", "options"),
    [
        ("sqpmethod", {"qpsol": "osqp", "hessian_approximation": "limited-memory"}),
        ("sqpmethod", {"qpsol": "osqp", "convexify_strategy": "eigen-clip"}),
        ("ipopt", {"ipopt": {"print_level": 0, "hessian_approximation": "limited-memory"}}),
        ("ipopt", {"ipopt": {"print_level": 0}}),
    ],
)
def test_solvers_of_casadi_raise_the_impulse_of_a_velocity(solver: str, options: dict[str, Any]) -> None:
    """The hardest blow within a ball of velocities is on its rim, and the gradient points outwards there.

    The initial guess is so slow that the arm's weight keeps the contact up beyond the horizon: it needs
    `separated` among the outputs.
    """
    model, q, torque = hammer_blow()
    assert np.isnan(float(model.function(("impulse",))(q, [0.1, 0.3, 0.2], torque)))
    function = model.function(("impulse", "separated"), by=("v",))
    if solver == "sqpmethod":
        quiet = ("print_header", "print_iteration", "print_status", "print_time")
        inner = {"osqp": {"verbose": False, "eps_abs": 1e-7, "eps_rel": 1e-7}}
        options = {**options, **dict.fromkeys(quiet, False), "tol_du": 1e-4, "qpsol_options": inner}
    else:
        options = {**options, "print_time": False}
    opti = ca.Opti()
    v = opti.variable(3)
    impulse = function(q, v, torque)[0]
    opti.minimize(-impulse)
    opti.subject_to(ca.sumsqr(v) <= 1)
    opti.set_initial(v, [0.1, 0.3, 0.2])
    opti.solver(solver, options)
    best = opti.solve()
    gradient = best.value(ca.gradient(impulse, v))
    cosine = gradient @ best.value(v) / np.linalg.norm(gradient) / np.linalg.norm(best.value(v))
    assert np.linalg.norm(best.value(v)) == pytest.approx(1, abs=1e-4)
    assert cosine == pytest.approx(1, abs=1e-5)


def test_a_line_search_steps_back_from_contacts_without_end() -> None:
    """Of the velocities that give 0.53 N s, from a faster one: IPOPT's first steps go where the hammer is so
    slow that it leans on the target beyond the horizon, where the impulse is NaN."""
    model, q, torque = hammer_blow()
    impulse = model.function(("impulse",), by=("v",))
    met: list[bool] = []

    class Watched(ca.Callback):
        """The objective, seen."""

        def __init__(self) -> None:
            ca.Callback.__init__(self)
            self.construct("watched", {"enable_fd": True})

        def get_sparsity_in(self, i: int) -> Any:
            return ca.Sparsity.dense(3, 1)

        def eval(self, given: Any) -> Any:
            found = impulse(q, given[0], torque)
            met.append(bool(np.isnan(float(found))))
            return [found]

        def has_jacobian(self) -> bool:
            return True

        def get_jacobian(self, name: str, inames: Any, onames: Any, options: Any) -> Any:
            at, out = ca.MX.sym("at", 3), ca.MX.sym("out", 1)
            by_v = impulse.jacobian()(q, at, torque, 0)[1]
            return ca.Function(name, [at, out], [by_v], inames, onames, options)

    watched, opti = Watched(), ca.Opti()
    v = opti.variable(3)
    opti.minimize(100 * (watched(v) - 0.53) ** 2 + 1e-6 * ca.sumsqr(v))
    opti.subject_to(ca.sumsqr(v) <= 1)
    opti.set_initial(v, [0.5, 0.77, 0.38])
    opti.solver("ipopt", {"ipopt": {"print_level": 0, "hessian_approximation": "limited-memory"}})
    best = opti.solve()
    assert any(met) and not met[0]
    assert best.value(watched(v)) == pytest.approx(0.53, abs=1e-6)


def hammer_blow() -> tuple[SDC, Any, Any]:
    """(an arm's model, with so short a horizon that slow blows do not end; q; torque)."""
    arm = planar_arm()
    light: dict[str, Any] = {"law": SpringDamper(stiffness=1e4, damping=100.0), "target": FreeMass(mass=1.0)}
    model = SDC(robot=arm, striker="hammer", normal=[0, 0, -1], **light, horizon=0.05)
    return model, arm.posture("ready"), np.zeros(3)
