"""Compiled Jacobians of a collision's histories: against differences, exact collisions, and gradients."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support.implicit_cases import exact, gradient, implicit
from support.native_cases import FRICTION, call, situation

from impactopt import Board, BothSoles, Effects, InputError, KelvinVoigt, Nail, RigidWall, VirtualMass
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.outputs import HISTORIES, SCALARS

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
]

SHORT: dict[str, Any] = {"step": 2e-3, "horizon": 0.03}
SLIDING = {"effects": Effects(friction=True), "friction": dataclasses.replace(FRICTION, transition=0.33)}


def differentiable(model: Any) -> tuple[str, ...]:
    return tuple(name for name in model.available if name in (*SCALARS, *HISTORIES))


def jacobians(model: Any, outputs: tuple[str, ...], values: list[Any], **options: Any) -> dict[str, Any]:
    return call(model.jacobian_function(outputs, parameters=tuple(model.settings), **options), values)


def stepped(model: Any, outputs: tuple[str, ...], values: list[Any]) -> Callable[[Any, Any], dict[str, Any]]:
    """Entries of the outputs, column by column, by q and v."""
    function = model.function(outputs, parameters=tuple(model.settings))

    def collision(q: Any, v: Any) -> dict[str, Any]:
        found = call(function, [q, v, *values[2:]])
        return {name: found[name].ravel(order="F") for name in outputs}

    return collision


def slopes(collision: Callable[[Any, Any], dict[str, Any]], model: Any, values: list[Any], way: Any) -> Any:
    """Central differences along `way` with Richardson's extrapolation."""
    robot, (q, v) = model.robot, values[:2]

    def slope(h: float) -> dict[str, Any]:
        ahead, behind = (
            collision(pin.integrate(robot.model, q, t * way[: robot.nv]), v + t * way[robot.nv :])
            for t in (h, -h)
        )
        return {name: (ahead[name] - behind[name]) / (2 * h) for name in ahead}

    near, far = slope(5e-5), slope(1e-4)
    return {name: (4 * near[name] - far[name]) / 3 for name in near}


def assert_slopes(
    collision: Callable[[Any, Any], dict[str, Any]],
    found: dict[str, Any],
    model: Any,
    values: list[Any],
    ways: Any,
    rel: float = 1e-6,
) -> None:
    """Along each way, within `rel` of the largest derivative, or of the output where that is larger: steps
    end a little beyond an event, by what no derivative knows."""
    for way in ways:
        for name, true in slopes(collision, model, values, way).items():
            along = np.hstack([found[f"{name}_by_q"], found[f"{name}_by_v"]]) @ way
            scale = max(np.abs(true).max(), np.abs(found[name]).max())
            assert np.abs(along[: true.size] - true).max() <= rel * scale, name


def changes(x: Any) -> int:
    return int((x[:, :-1] != x[:, 1:]).sum())


# ------------------------------------------------------------ against differences
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "an arm that slides, a nail": (
        "arm",
        {**SLIDING, "target": Nail(mass=0.2, resistance=80.0, hardening=1e4)},
    ),
    "an arm, a board": ("arm", {"target": Board(mass=0.5, stiffness=2e4, breaking_force=60.0), "step": 1e-3}),
    "an arm, a wall": ("arm", {"target": RigidWall(), "law": KelvinVoigt(stiffness=1e4, damping=50.0)}),
    "a biped that slides": ("biped", SLIDING),
    "a biped without drifts": ("biped", {"effects": Effects(bias=False, jdot=False)}),
}


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow) if "biped" in case else case for case in CASES]
)
def test_each_column_is_that_of_differences(case):
    name, options = CASES[case]
    model = implicit(name, **{**SHORT, **options})
    values, outputs = situation(name, model), differentiable(model)
    found = jacobians(model, outputs, values)
    for output in outputs:
        assert np.abs(found[f"{output}_by_q"]).max() > 0 or output == "separated" or not found["separated"]
    assert_slopes(stepped(model, outputs, values), found, model, values, np.eye(2 * model.robot.nv))


@pytest.mark.slow
@pytest.mark.usefixtures("as_shipped")
def test_joints_that_saturate_and_slide_on_the_way():
    model, limit = implicit("arm", **SHORT | SLIDING | {"step": 5e-4}), np.array([30.0, 36.0, 8.0, 3.5])
    values, names = situation("arm", model), ["q", "v", "feedforward", *model.settings]
    values[2], values[names.index("torque_limit")] = np.zeros(4), limit
    outputs = ("torque", "joint_velocity", "demand", "force", "time", "impulse")
    found = jacobians(model, outputs, values)
    assert changes(np.abs(found["torque"]) == limit[:, None]) > 2
    assert changes(np.abs(found["joint_velocity"]) > SLIDING["friction"].transition) > 2
    assert_slopes(stepped(model, outputs, values), found, model, values, np.eye(8))


@pytest.mark.slow
def test_a_stand_in_in_random_directions():
    model = implicit("standin", stance=BothSoles(hands=("left_hand",)), **SHORT)
    values, outputs = situation("standin", model), ("zmp", "torque", "hand_wrench", "separated")
    ways = np.random.default_rng(0).normal(size=(4, 2 * model.robot.nv)) / 5
    assert_slopes(stepped(model, outputs, values), jacobians(model, outputs, values), model, values, ways)


# ------------------------------------------------------------ against exact collisions
@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if "biped" in case])
def test_columns_are_those_of_exact_collisions(case):
    model = implicit("biped", **SHORT | CASES[case][1])
    values, outputs = situation("biped", model), differentiable(model)
    found, true = jacobians(model, outputs, values), exact(model, values)

    def collision(q: Any, v: Any) -> dict[str, Any]:
        made = true(q, v)
        # its columns are at events too
        kept = np.isclose(made.time / model.step, np.round(made.time / model.step), rtol=0, atol=1e-9)
        kept[-1] = True
        histories = {name: getattr(made, name)[kept].ravel() for name in outputs if name in HISTORIES}
        return histories | {name: np.array([getattr(made, name)]) for name in ("impulse", "duration")}

    ways = np.random.default_rng(2).normal(size=(1, 2 * model.robot.nv)) / 5
    for name, value in collision(*values[:2]).items():
        assert np.abs(found[name].ravel(order="F")[: value.size] - value).max() <= 1e-6 * np.abs(value).max()
    assert_slopes(collision, found, model, values, ways)


# ------------------------------------------------------------ against gradients
# implicit steps keep their error below the tolerance, and have none to differentiate
NUMBERS = tuple(name for name in SCALARS if name != "step_error")


@pytest.mark.parametrize("output", NUMBERS)
def test_rows_of_numbers_are_their_gradients(output):
    model = implicit("arm", **SHORT, target=Nail(mass=0.2, resistance=80.0))
    values = situation("arm", model)
    found = jacobians(model, NUMBERS, values)
    value, by_q, by_v = gradient(model, output, values)
    assert found[output] == pytest.approx(value, rel=1e-12)
    assert found[f"{output}_by_q"][0] == pytest.approx(by_q, rel=1e-9, abs=1e-12)
    assert found[f"{output}_by_v"][0] == pytest.approx(by_v, rel=1e-9, abs=1e-12)


def test_a_point_mass_has_jacobians_too():
    model = implicit("arm", VirtualMass, **SHORT)
    values, outputs = situation("arm", model), ("force", "hand_speed", "energy")
    found = jacobians(model, outputs, values)
    assert_slopes(stepped(model, outputs, values), found, model, values, np.eye(8))


# ------------------------------------------------------------ inputs and outputs
def test_names_shapes_and_what_is_kept():
    model, outputs = implicit("arm", **SHORT), ("torque", "force")
    some, whole = (model.jacobian_function(outputs, every=every) for every in (3, 1))
    assert some.name_in() == ["q", "v", "feedforward"]
    assert some.name_out() == [f"{name}{by}" for name in outputs for by in ("", "_by_q", "_by_v")]
    shapes = [(4, 6), (24, 4), (24, 4), (6, 1), (6, 4), (6, 4)]
    assert [some.size_out(i) for i in range(6)] == shapes
    values = situation("arm", model)[:3]
    found, every = call(some, values), call(whole, values)
    # rows are the entries column by column
    for by in ("torque_by_q", "torque_by_v"):
        columns = every[by].reshape(-1, 4, 4)[[0, 3, 6, 9, -1]]
        assert found[by].reshape(-1, 4, 4)[[0, 1, 2, 3, -1]] == pytest.approx(columns, rel=1e-12)


def test_what_is_no_number_has_no_jacobian():
    model = implicit("arm", **SHORT)
    values = situation("arm", model)
    values[1] = np.array([np.nan, 0.0, 0.0, 0.0])
    found = jacobians(model, ("torque", "impulse"), values)
    assert all(np.isnan(x).all() for name, x in found.items() if "_by_" in name)


def test_hands_that_part_are_moved_by_nothing():
    model = implicit("arm", **SHORT)
    found = jacobians(model, ("force", "impulse", "time"), situation("arm", model, speed=-1.0))
    assert all((x == 0.0).all() for x in found.values())


@pytest.mark.parametrize(
    ("options", "output", "why"),
    [
        ({}, "velocity", "Jacobian of 'velocity'"),
        ({"freezes": 2}, "torque", "freezes=0"),
        ({"method": "rk4"}, "torque", "not of 'rk4'"),
    ],
)
def test_other_models_are_refused(options, output, why):
    with pytest.raises(InputError, match=why):
        implicit("arm", **options).jacobian_function((output,))


def test_a_jacobian_by_what_is_no_input_is_refused():
    with pytest.raises(InputError, match="no Jacobian by 'feedforward'; there are q, v"):
        implicit("arm", VirtualMass, **SHORT).jacobian_function(("impulse",), by=("q", "feedforward"))


@pytest.mark.slow
def test_tangents_stay_within_the_bounds_of_their_arrays(tmp_path: Path) -> None:
    """Under the compiler's sanitizer of undefined behaviour, which ends the process."""
    script = (
        "import numpy as np\nfrom support import small_robots\n"
        "from impactopt.collision import SDC\n"
        "from impactopt.contact import FreeMass, SpringDamper\n"
        "law = SpringDamper(stiffness=1e4, damping=300.0)\n"
        "model = SDC(robot=small_robots.slider(2.0), striker='tip', normal=[1, 0, 0], law=law,\n"
        "            target=FreeMass(mass=5.0), horizon=0.1)\n"
        "print(float(model.jacobian_function(('impulse',))([0.0], [1.0], [0.0])[0]))\n"
    )
    environment = {
        **os.environ,
        "CC": "cc -fsanitize=undefined -fno-sanitize-recover=undefined",
        "IMPACTOPT_CACHE": str(tmp_path / "cache"),
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path]),
    }
    command = [sys.executable, "-W", "error::impactopt.errors.NoCompilerWarning", "-c", script]
    if find_compiler() is None or "ubsan" not in _libraries_of_cc():
        pytest.skip("no compiler with that sanitizer")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 1.0


def _libraries_of_cc() -> str:
    asked = ["cc", "-print-file-name=libubsan.so"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    return found if os.path.isabs(found) else ""
