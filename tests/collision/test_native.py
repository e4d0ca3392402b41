"""Collisions in C written by hand: equal to the graphs they replace, and to closed forms; safe in threads."""

from __future__ import annotations

import ctypes
import dataclasses
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from support import small_robots
from support.frozen_cases import two_masses
from support.native_cases import (
    FRICTION,
    HARDENING,
    LAW,
    TARGET,
    X,
    call,
    inputs,
    native,
    sdc,
    situation,
)

from impactopt import (
    SDC,
    Board,
    BothSoles,
    Effects,
    HuntCrossley,
    KelvinVoigt,
    Nail,
    OneSole,
    RigidWall,
    VirtualMass,
)
from impactopt.codegen.cache import cached
from impactopt.codegen.compiler import find_compiler
from impactopt.collision.graph import collision_graph, gradient_graph
from impactopt.collision.native import native_gradient

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::impactopt.errors.NoCompilerWarning"),
]


def assert_same(model: Any, values: list[Any], outputs: tuple[str, ...], every: int = 1) -> dict[str, Any]:
    made, graph = native(model, outputs, every), collision_graph(model, outputs, every=every)
    assert made.name_in() == graph.name_in() and made.name_out() == graph.name_out()
    for name in made.name_in():
        assert made.size_in(name) == graph.size_in(name), name
    found, true = call(made, values), call(graph, values)
    for name, value in true.items():
        assert found[name].shape == value.shape, name
        scale = max(float(np.abs(value).max()), 1e-9)
        assert np.abs(found[name] - value).max() <= 1e-11 * scale, name
    return found


# ------------------------------------------------------------ against the graphs
GAINS = 0.5 * np.ones((4, 4)) + np.diag([20.0, 30.0, 20.0, 10.0])
ARMS = {
    "friction": {"effects": Effects(friction=True), "friction": FRICTION},
    "friction only": {"effects": dataclasses.replace(Effects.none(), friction=True), "friction": FRICTION},
    "nothing but damping": {"effects": Effects.none()},
    "matrices of gains": {"kp": 10 * GAINS, "kd": GAINS},
    "a nail": {"target": Nail(mass=0.2, resistance=80.0, hardening=1e4), "effects": Effects(bias=False)},
    "a board, hardening": {
        "target": Board(mass=0.5, stiffness=2e4, breaking_force=60.0),
        "law": HARDENING,
        "effects": Effects(jdot=False),
    },
    "a wall": {"target": RigidWall(), "law": KelvinVoigt(stiffness=1e4, damping=50.0)},
    "a rounded hand": {"law": HuntCrossley(stiffness=1e6, dissipation=0.3)},
    "freezes": {"freezes": 3, "target": Nail(mass=0.2, resistance=80.0)},
    "freezes and friction": {
        "freezes": 2,
        "effects": Effects(friction=True),
        "friction": FRICTION,
    },
}


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("name", ARMS)
def test_an_arm_in_c_is_the_graph(name):
    model = sdc("arm", **ARMS[name])
    values = situation("arm", model)
    found = assert_same(model, values, model.available, every=3 if name == "friction" else 1)
    assert found["impulse"] > 0.1


def test_joints_that_saturate_and_slide_on_the_way_are_those_of_the_graph():
    friction = dataclasses.replace(FRICTION, transition=0.33)
    model = sdc("arm", effects=Effects(friction=True), friction=friction)
    values = situation("arm", model)
    names = ["q", "v", "feedforward", *model.settings]
    values[names.index("feedforward")] = np.zeros(4)
    values[names.index("torque_limit")] = np.array([30.0, 36.0, 8.0, 3.5])
    found = assert_same(model, values, ("torque", "joint_velocity", "time", "impulse"))
    saturated = np.abs(found["torque"]) == values[names.index("torque_limit")][:, None]
    sliding = np.abs(found["joint_velocity"]) > friction.transition
    assert (saturated[:, :-1] != saturated[:, 1:]).sum() > 2
    assert (sliding[:, :-1] != sliding[:, 1:]).sum() > 2


def test_a_point_mass_in_c_is_the_graph():
    model = sdc("arm", VirtualMass)
    assert_same(model, situation("arm", model), model.available)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {
            "stance": OneSole("left", base_mass=1e4, base_inertia=1e4),
            "method": "rk4",
            "effects": Effects.paper(),
        },
        {"horizon": 0.004, "freezes": 1},
    ],
    ids=["both soles", "one sole on a virtual base", "not separated"],
)
def test_a_biped_in_c_is_the_graph(options):
    model = sdc("biped", **options)
    found = assert_same(model, situation("biped", model), model.available)
    assert found["separated"] == float("horizon" not in options)


def test_a_held_hand_in_c_is_the_graph():
    model = sdc("standin", stance=BothSoles(hands=("left_hand",)))
    outputs = ("hand_wrench", "zmp", "impulse", "separated")
    assert_same(model, situation("standin", model), outputs, every=5)


# ------------------------------------------------------------ gradients
def gradient(model: Any, output: str) -> Any:
    recipe = (*model._recipe, output)
    return cached("native_gradient", recipe, lambda: [native_gradient(model, output)])["collision_gradient"]


GRADIENTS = {
    "all terms": ("impulse", {"effects": Effects(friction=True), "friction": FRICTION}),
    "nothing but damping": ("impulse", {"effects": Effects.none()}),
    "matrices of gains": ("impulse", {"kp": 10 * GAINS, "kd": GAINS, "effects": Effects(jdot=False)}),
    "a nail": ("energy", {"target": Nail(mass=0.2, resistance=80.0, hardening=1e4)}),
    "a wall, to the horizon": (
        "peak_force",
        {"target": RigidWall(), "law": KelvinVoigt(stiffness=1e4, damping=5.0), "horizon": 0.003},
    ),
    "longer steps": (
        "energy",
        {"step": 5e-4, "effects": Effects(friction=True, bias=False), "friction": FRICTION},
    ),
    "a rounded hand": ("peak_force", {"law": HuntCrossley(stiffness=1e6, dissipation=0.3)}),
}


def assert_same_gradient(model: Any, values: list[Any], output: str) -> dict[str, Any]:
    made, graph = gradient(model, output), gradient_graph(model, output)
    assert made.name_in() == graph.name_in() and made.name_out() == graph.name_out()
    found, true = call(made, values), call(graph, values)
    for name, value in true.items():
        assert found[name].shape == value.shape, name
        scale = max(float(np.abs(value).max()), 1e-6)
        assert np.abs(found[name] - value).max() <= 1e-10 * scale, name
    return found


@pytest.mark.usefixtures("as_shipped")
@pytest.mark.parametrize("name", GRADIENTS)
def test_an_arms_gradient_in_c_is_the_graphs(name):
    output, options = GRADIENTS[name]
    model = sdc("arm", **options)
    found = assert_same_gradient(model, situation("arm", model), output)
    assert max(np.abs(found[f"{output}_by_{x}"]).max() for x in "qv") > 1e-3


def test_a_bipeds_gradient_in_c_is_the_graphs_and_that_of_differences():
    model = sdc("biped")
    robot, values = model.robot, situation("biped", model)
    found = assert_same_gradient(model, values, "impulse")
    function, (q, v, *others) = native(model, ("impulse",)), values
    rng, h = np.random.default_rng(1), 1e-6
    for _ in range(4):
        way, change = rng.normal(size=(2, robot.nv))
        ahead, behind = (
            call(function, [pin.integrate(robot.model, q, t * way), v + t * change, *others])["impulse"]
            for t in (h, -h)
        )
        slope = (found["impulse_by_q"].T @ way + found["impulse_by_v"].T @ change).item()
        assert (ahead - behind).item() / (2 * h) == pytest.approx(slope, rel=1e-6)


def test_a_point_masses_gradient_in_c_is_the_graphs():
    model = sdc("arm", VirtualMass)
    assert_same_gradient(model, situation("arm", model), "impulse")


def test_a_gradient_says_where_it_has_no_numbers():
    model = sdc("arm")
    values = situation("arm", model)
    values[1] = np.array([np.nan, 0.0, 0.0, 0.0])
    found = call(gradient(model, "impulse"), values)
    assert all(np.isnan(x).all() for x in found.values())


# ------------------------------------------------------------ against closed forms
def test_a_slider_in_c_is_two_masses():
    robot = small_robots.slider(3.0)
    options = {"law": LAW, "target": TARGET, "effects": Effects.none(), "tolerance": 1e-11}
    model = SDC(robot=robot, striker="tip", normal=X, **options)
    found = call(native(model, ("impulse", "duration")), inputs(model, [0.1], [1.2], [0.0]))
    impulse, duration = two_masses(3.0, TARGET.mass, LAW.stiffness, LAW.damping, 1.2)
    assert found["impulse"] == pytest.approx(impulse, rel=1e-9)
    assert found["duration"] == pytest.approx(duration, rel=1e-6)


# ------------------------------------------------------------ robust
@pytest.mark.parametrize("method", ["implicit", "rk4"])
def test_what_is_no_number_comes_out_as_none(method):
    model = sdc("arm", method=method)
    made = native(model, ("impulse", "duration", "velocity", "separated"))
    values = situation("arm", model)
    for place in range(3):
        broken = [np.array(x, dtype=float) for x in values]
        broken[place][-1] = np.nan
        found = call(made, broken)
        assert all(np.isnan(value).all() for value in found.values()), place
    assert np.isfinite(call(made, values)["impulse"])


def test_hands_that_part_have_no_collision():
    model = sdc("arm")
    found = assert_same(model, situation("arm", model, speed=-1.0), ("impulse", "duration", "force"))
    assert found["impulse"] == 0.0 and found["duration"] == 0.0


def test_two_threads_at_once_do_not_meet(tmp_path, monkeypatch):
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path))
    model = sdc("arm")
    made = native(model, ("impulse", "torque"))
    cases = [situation("arm", model, seed=seed) for seed in range(8)]
    expected = [call(made, values)["impulse"].item() for values in cases]
    (library,) = Path(tmp_path).glob("*.so")
    function = ctypes.CDLL(str(library)).collision  # ctypes lets go of the interpreter's lock
    wrong: list[float] = []

    def work(mine: list[int]) -> None:
        doubles = ctypes.POINTER(ctypes.c_double)
        memory = np.zeros(made.sz_w())
        out = [np.zeros(made.nnz_out(i)) for i in range(made.n_out())]
        for _ in range(100):
            for i in mine:
                given = [np.ascontiguousarray(np.ravel(x, order="F"), dtype=float) for x in cases[i]]
                arg = (doubles * len(given))(*[x.ctypes.data_as(doubles) for x in given])
                res = (doubles * len(out))(*[x.ctypes.data_as(doubles) for x in out])
                function(arg, res, None, memory.ctypes.data_as(doubles), 0)
                wrong.extend([i] if out[0].item() != expected[i] else [])

    threads = [threading.Thread(target=work, args=(list(range(k, 8, 2)),)) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_without_a_compiler_the_graph_takes_its_place(monkeypatch):
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    model = sdc("arm")
    values = situation("arm", model)
    made = native(model, ("impulse",))
    assert made.class_name() == "MXFunction"
    assert call(made, values)["impulse"] > 0.1
