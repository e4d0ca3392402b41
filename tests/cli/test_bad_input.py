"""Whatever is wrong with what is given: one clear error, at once, and nothing in it that a terminal obeys.

Each of these ended in a traceback, hung, or was called sound.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from support.small_plans import arm_problem

from impactopt import (
    SDC,
    FreeMass,
    InputError,
    KelvinVoigt,
    Perturbation,
    Robot,
    Tool,
    effective_mass,
    holding_torque,
    load_problem,
    load_robot,
    optimize_strike,
    solve,
    striking_velocity,
)
from impactopt.codegen.compiler import CompileError, Compiler, find_compiler
from impactopt.errors import printable
from impactopt.files.named_problems import problem_file
from impactopt.files.problem_file import read_problem_file
from impactopt.files.sections.diagnostics import key_lines
from impactopt.files.sections.reading import parse_settings
from impactopt.problem.phases import FINEST
from impactopt.report.page import html_page
from impactopt.simulation import simulate
from impactopt.solvers.ipm.newton import elimination_blocks
from impactopt.sweeps import read_sweep_file

ARM = problem_file("arm_planar").read_text(encoding="utf-8")
OWN = ARM.replace('robot = "planar_arm"\n', "") + '\n[robot]\npreset = "planar_arm"\n'
PUNCH = problem_file("punch_standin").read_text(encoding="utf-8")
AT_ONCE = 5.0  # [s]


def refused(text: str, tmp_path: Path) -> str:
    """What a problem file of this text is told."""
    path, began = tmp_path / "problem.toml", time.perf_counter()
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as error:
        load_problem(path)
    assert time.perf_counter() - began < AT_ONCE
    assert len(str(error.value)) < 20_000
    return str(error.value)


def with_key(key: str, value: str) -> str:
    """The arm's file with another line for a key."""
    lines = [f"{key} = {value}" if line.startswith(f"{key} =") else line for line in ARM.splitlines()]
    assert lines != ARM.splitlines()
    return "\n".join(lines)


@pytest.mark.parametrize("digits", [30, 400, 5000])
@pytest.mark.parametrize("key", ["mass_kg", "duration_s", "intervals", "point_m", "kp_N_m_rad"])
def test_whole_numbers_of_many_digits(tmp_path: Path, key: str, digits: int) -> None:
    number = "1" * digits
    text = OWN + f"kp_N_m_rad = {number}\n" if key == "kp_N_m_rad" else with_key(key, number)
    refused(text, tmp_path)


@pytest.mark.parametrize("depth", [40, 900, 20_000])
@pytest.mark.parametrize(("begin", "end"), [("[", "]"), ("{a = ", "}")])
def test_deep_nesting(tmp_path: Path, depth: int, begin: str, end: str) -> None:
    assert "nested deeper" in refused(f"{ARM}\n[solver.ipopt]\na = {begin * depth}1{end * depth}\n", tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (with_key("point_m", "[1e308, 0.0, 0.75]"), "point"),
        (with_key("mass_kg", "1e308"), "mass"),
        (with_key("mass_kg", "1e-308"), "mass"),
        (with_key("stiffness_N_m", "1e300"), "stiffness"),
        (with_key("damping_N_s_m", "1e300"), "damping"),
        (with_key("intervals", "100000000"), f"6 to {FINEST}"),
        (with_key("duration_s", "1e9"), "duration"),
        (OWN + "armature_kg_m2 = 1e300\n", "armature"),
        (OWN + "torque_limit_N_m = 1e299\n", "torque limit"),
        (OWN + '[[robot.strikers]]\nname = "s"\nframe = "hand"\npoint_m = [1e12, 0.0, 0.0]', "point"),
        (ARM + "\n[objective]\nsmoothness = 1e308\n", "smoothness"),
        (ARM.replace("[objectives.target_energy]", "[objectives.target_energy]\nweight = 1e308"), "weight"),
        (ARM.replace('"planar arm and a nail"', r'"a\u001b[2Jb"'), "control characters"),
        (ARM.replace("planar_arm", "planar_arm" * 100_000), "no robot"),
        (OWN + f'urdf = "{"a" * 5000}"\n', "one of preset, urdf and mjcf"),
        (OWN.replace('preset = "planar_arm"', f'urdf = "{"a" * 5000}.urdf"'), "no such file"),
        (OWN.replace('preset = "planar_arm"', 'urdf = "/dev/zero"'), "no such file"),
        (PUNCH + "".join(f'\n[[scenarios]]\nname = "s{i}"' for i in range(20_000)), "give at most 100"),
        (ARM + "[x]\n" + "".join(f"k{i} = 1\n" for i in range(20_000)), "x"),
        (ARM + "[solver.ipopt]\n" + "".join(f"k{i} = 1\n" for i in range(20_000)), "ipopt"),
        (f"{ARM}\n#{'a' * (1 << 23)}", "larger than"),
    ],
)  # fmt: skip
def test_numbers_and_names_that_cannot_be_meant(tmp_path: Path, text: str, said: str) -> None:
    found = refused(text, tmp_path)
    assert said in found, found[:500]


def test_a_long_line_costs_no_more_than_its_length() -> None:
    began = time.perf_counter()
    lines = key_lines(f'[a . "b"]\nc = 1\n[{" " * 30_000}\n[{"x " * 30_000}\n' + "[[d]]\n" * 20_000)
    assert time.perf_counter() - began < AT_ONCE
    assert lines["a", "b", "c"] == 2 and lines["d", 19_999] == 20_004


@pytest.mark.parametrize("read", [load_problem, read_sweep_file])
@pytest.mark.parametrize(
    "name", ["pipe.toml", "/dev/zero", "a" * 5000, f"{'a' * 5000}.toml", "a\0.toml", "folder.toml"]
)
def test_what_is_no_plain_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: Callable[[str], Any], name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.toml")
    Path("folder.toml").mkdir()
    with pytest.raises(InputError) as error:
        read(name)
    assert len(str(error.value)) < 2000


@pytest.mark.parametrize(
    "setting", ["target.mass=" + "1" * 5000, ".".join("a" * 5000) + "=1", "problem.point=" + "[" * 900]
)
def test_settings(setting: str) -> None:
    with pytest.raises(InputError) as error:
        read_problem_file("arm_planar", parse_settings([setting]))
    assert len(str(error.value)) < 2000


LINK = '<link name="{}"><inertial>{}<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{}</link>'  # noqa: E501
JOINT = (
    '<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("body", ["", LINK.format("a", "", "")])
def test_a_robot_without_joints(tmp_path: Path, floating: bool, body: str) -> None:
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{body}</robot>')
    with pytest.raises(InputError, match=r"movable joints|URDF"):
        Robot.from_urdf(tmp_path / "r.urdf", floating=floating)


@pytest.mark.parametrize("numbers", ["a b c", "1 1", "", "nan nan nan", "1e400 0 0", "1 2 3 4 5"])
def test_shapes_and_colours_that_are_none_are_left_out(tmp_path: Path, numbers: str) -> None:
    from impactopt.bodies.visuals import visuals_of

    shape = (
        '<visual><origin rpy="{0}" xyz="{0}"/><geometry><box size="1 1 1"/></geometry></visual>'
        '<visual><geometry><box size="1 1 1"/></geometry><material name="m"><color rgba="{0}"/></material>'
        "</visual>"
    )
    links = LINK.format("a", "", "") + LINK.format("b", "", shape.format(numbers))
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{links}{JOINT}</robot>')
    path = tmp_path / "r.urdf"
    found = visuals_of(Robot.from_urdf(path, floating=False, urdf=path))
    assert found and all(np.isfinite(v.solid.vertices).all() and np.isfinite(v.colour).all() for v in found)


@pytest.mark.parametrize(
    ("inertia", "head"),
    [([-1e-3, 1e-3, 1e-3], [0, 0, 0.1]), ([1e300] * 3, [0, 0, 0.1]), ([1e-3] * 3, [1e12, 0, 0])],
)
def test_tools_that_are_no_bodies(inertia: list[float], head: list[float]) -> None:
    with pytest.raises(InputError, match="tool 't'"):
        Tool(
            name="t",
            frame="hand",
            mass=1.0,
            center=np.zeros(3),
            inertia=np.array(inertia),
            head=np.array(head),
        )


@pytest.mark.parametrize("name", ["mass", "payload", "distance", "missing", "delay"])
@pytest.mark.parametrize("value", ["x", None, [1.0, 2.0], np.nan, 1e300])
def test_conditions_are_numbers(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f"perturbation: {name}"):
        Perturbation(**{name: value})


def test_a_payload_that_no_engine_takes() -> None:
    with pytest.raises(InputError, match="payload is 1e-12"):
        Perturbation(payload=1e-12)


@pytest.mark.parametrize("plan", [solve, optimize_strike])
@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"options": {"x": 1}}, "no option 'x'"),
        ({"options": {"max_iteration": 1}}, "did you mean 'max_iterations'"),
        ({"options": {"max_iterations": "a"}}, "max_iterations"),
        ({"options": {"max_iterations": 1.5}}, "whole number"),
        ({"options": {"second_order_correction": 3}}, "true or false"),
        ({"options": [1]}, "options"),
        ({"solver": "ipopt", "options": {"x": 1}}, "IPOPT"),
        ({"solver": "ipopt", "options": {"constr_viol_tol": "a"}}, "constr_viol_tol"),
        ({"time_limit": "x"}, "time_limit"),
        ({"time_limit": np.nan}, "time_limit"),
        ({"time_limit": 0}, "time_limit"),
    ],
)
def test_options_of_solvers(plan: Callable[..., Any], given: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        plan(arm_problem(), **given)


class Motion:
    end = 1.0


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco"])
@pytest.mark.parametrize(
    "options",
    [
        *({"settle": x} for x in (-1.0, np.nan, np.inf, 1e9, "x")),
        *({"step": x} for x in (0.0, -1.0, np.nan, np.inf, 1e-300, 1.0)),
        {"step": 1e-6, "settle": 60.0},
    ],
)
def test_times_of_replays(engine: str, options: dict[str, Any]) -> None:
    name = next(iter(options))
    with pytest.raises(InputError, match=name):
        simulate(arm_problem(), Motion(), engine=engine, **options)


def test_a_compiler_that_is_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "gcc 'x")
    with pytest.raises(InputError, match='CC is "gcc \'x"'):
        find_compiler()


def test_a_compiler_whose_children_hang_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "cc"
    script.write_text("#!/bin/sh\nsleep 60 &\nwait\n")  # the child holds the output open
    script.chmod(0o755)
    monkeypatch.setattr("impactopt.codegen.compiler._LONGEST", 0.2)
    began = time.perf_counter()
    with pytest.raises(CompileError, match=r"0\.2 s"):
        Compiler(command=(str(script),), version="1").run(tmp_path / "a.c", tmp_path / "a.so", "-O1")
    assert time.perf_counter() - began < AT_ONCE


def test_a_port_that_takes_connections_and_never_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    from impactopt.sweeps import cluster

    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.5)
    with socket.socket() as port:
        port.bind(("127.0.0.1", 0))
        port.listen()
        with (
            pytest.raises(InputError, match="no Dask scheduler answers"),
            cluster.connected(f"tcp://127.0.0.1:{port.getsockname()[1]}"),
        ):
            pass


def test_marks_in_names_are_no_marks_of_a_page() -> None:
    page = html_page(title="{{scripts}}", kind="report", body="{{numbers}} {{x}}", header={}, arrays={})
    assert page.count("<title>{{scripts}}</title>") == 1 and "{{numbers}} {{x}}" in page


def test_a_terminal_obeys_nothing_of_a_message() -> None:
    assert printable("a\x1b[2J\x07\x9bb\nc\u202e\u00e9") == "a\\x1b[2J\\x07\\x9bb\nc\\u202e\u00e9"


def test_a_chain_of_thousands_is_ordered() -> None:
    n = 3000
    pattern = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1
    order = np.concatenate(elimination_blocks(pattern))
    assert sorted(order.tolist()) == list(range(n))


def test_no_number_in_none_out() -> None:
    robot = load_robot("planar_arm")
    q, normal = robot.posture("ready"), np.array([0.0, 0.0, -1.0])
    model = SDC(
        robot=robot,
        striker="hammer",
        normal=normal,
        law=KelvinVoigt(stiffness=1e5, damping=10.0),
        target=FreeMass(mass=1.0),
    )
    v = striking_velocity(robot, q, "hammer", normal, 1.0)
    names = ("contact_stiffness", "torque_limit", "kd", "target_mass")
    known = {**model.settings, "q": q, "v": v, "feedforward": holding_torque(robot, q)}
    for function in (
        model.function(("impulse", "duration"), parameters=names),
        model.gradient_function("impulse", parameters=names),
    ):
        inputs = {name: np.array(known[name], dtype=float) for name in function.name_in()}
        assert all(np.isfinite(np.array(out)).all() for out in function.call([*map(ca.DM, inputs.values())]))
        for name, value in inputs.items():
            spoiled = {**inputs, name: np.where(np.arange(value.size) == 0, np.nan, value)}
            found = function.call([ca.DM(x) for x in spoiled.values()])
            assert all(np.isnan(np.array(out)).all() for out in found), name
    assert np.isnan(float(effective_mass(robot, striker="hammer", normal=normal)(q * np.nan)))
    for bad in (np.nan, np.inf):
        with pytest.raises(InputError):
            striking_velocity(robot, q, "hammer", normal, bad)
        with pytest.raises(InputError):
            striking_velocity(robot, q * bad, "hammer", normal, 1.0)
        with pytest.raises(InputError):
            holding_torque(robot, q, np.full(robot.nv, bad))
    with pytest.raises(InputError):
        holding_torque(robot, q, np.full(robot.nv, 1e200))
    with pytest.raises(InputError, match=r"normal: not a unit vector \(length 2\)"):
        striking_velocity(robot, q, "hammer", 2 * normal, 1.0)
