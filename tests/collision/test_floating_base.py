"""A robot that floats freely: Khatib's effective mass, momentum, two engines, and who cannot float."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from typer.testing import CliRunner

from impactopt import (
    SDC,
    FixedBase,
    Free,
    FreeMass,
    FullDynamics,
    InputError,
    MujocoDynamics,
    Robot,
    SpringDamper,
    Striker,
    effective_mass,
    planar_arm,
    striking_velocity,
)
from impactopt.cli.app import app

NORMAL = np.array([0.0, 1.0, 0.0])
LAW, TARGET = SpringDamper(stiffness=1e4, damping=100.0), FreeMass(mass=1.0)
LINK = (
    '<link name="{name}"><inertial><origin xyz="{x} 0 0"/><mass value="{mass}"/><inertia ixx="{i}" iyy="{i}" '
    'izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{x} 0 '
    '{z}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="500" velocity="20"/></joint>'
)
TEXT = "".join(
    (
        '<robot name="satellite">',
        LINK.format(name="base", x=0, mass=20, i=1.0),
        LINK.format(name="a", x=0.2, mass=2.0, i=0.03),
        LINK.format(name="b", x=0.2, mass=1.5, i=0.02),
        LINK.format(name="c", x=0.1, mass=0.7, i=0.01),
        JOINT.format(name="j1", parent="base", child="a", x=0.3, z=0.1, axis="0 0 1"),
        JOINT.format(name="j2", parent="a", child="b", x=0.4, z=0, axis="0 0 1"),
        JOINT.format(name="j3", parent="b", child="c", x=0.4, z=0, axis="0 1 0"),
        "</robot>",
    )
)


@pytest.fixture
def satellite(tmp_path: Path) -> Robot:
    (tmp_path / "satellite.urdf").write_text(TEXT)
    hand = Striker(name="hand", frame="c", point=np.array([0.2, 0.0, 0.0]))
    return Robot.from_urdf(tmp_path / "satellite.urdf", floating=True, armature=0.01, strikers=[hand])


def _posture(robot: Robot, seed: int) -> Any:
    rng = np.random.default_rng(seed)
    return pin.integrate(robot.model, pin.neutral(robot.model), rng.normal(size=robot.nv))


def test_its_effective_mass_is_that_of_the_whole_tree(satellite: Robot) -> None:
    """1 / (n' J H^-1 J' n) with H and J of Pinocchio, base included."""
    function = effective_mass(satellite, striker="hand", normal=NORMAL, stance=Free())
    model, data = satellite.model, satellite.model.createData()
    frame = model.getFrameId(satellite.striker("hand").model_frame)
    for seed in range(5):
        q = _posture(satellite, seed)
        upper = np.triu(pin.crba(model, data, q))
        inertia = upper + np.triu(upper, 1).T
        n = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)[:3].T @ NORMAL
        assert float(function(q)) == pytest.approx(1.0 / (n @ np.linalg.solve(inertia, n)), rel=1e-10)


@pytest.mark.slow
def test_a_blow_moves_its_base_and_total_momentum_stays(satellite: Robot) -> None:
    """Across gravity nothing acts from outside: what the target gets, the robot loses."""
    q, model, data = _posture(satellite, 1), satellite.model, satellite.model.createData()
    v = striking_velocity(satellite, q, "hand", NORMAL, 1.0, stance=Free())
    how: dict[str, Any] = {
        "robot": satellite,
        "striker": "hand",
        "normal": NORMAL,
        "law": LAW,
        "target": TARGET,
    }
    full = FullDynamics(**how, stance=Free()).collide(q, v, np.zeros(3))
    before = pin.computeCentroidalMomentum(model, data, q, v).linear[1]
    after = pin.computeCentroidalMomentum(model, data, full.configuration, full.velocity).linear[1]
    assert full.impulse == pytest.approx(TARGET.mass * np.ravel(full.target_speed)[-1], rel=1e-6)
    assert before - after == pytest.approx(full.impulse, rel=1e-4)
    assert full.zmp is None
    frozen = SDC(**how, stance=Free(), freezes=8).collide(q, v, np.zeros(3))
    other = MujocoDynamics(**how, stance=Free()).collide(q, v, np.zeros(3))
    assert frozen.impulse == pytest.approx(full.impulse, rel=2e-3)
    assert other.impulse == pytest.approx(full.impulse, rel=1e-4)


def test_bolted_robots_refuse_it() -> None:
    with pytest.raises(InputError, match=r"has a fixed base: give stance=FixedBase\(\)"):
        effective_mass(planar_arm(), striker="hammer", normal=NORMAL, stance=Free())
    assert FixedBase() != Free()


def test_the_command_collides_it(tmp_path: Path, satellite: Robot) -> None:
    (tmp_path / "satellite.toml").write_text("""
        problem = {striker = "hand", point_m = [0.9, 0.2, 0.0], normal = [0.0, 1.0, 0.0], start = "ready"}
        target = {mass_kg = 1.0}
        contact = {stiffness_N_m = 1e4, damping_N_s_m = 100.0}
        stance = {soles = "none"}
        [robot]
        urdf = "satellite.urdf"
        armature_kg_m2 = 0.01
        strikers = [{name = "hand", frame = "c", point_m = [0.2, 0.0, 0.0]}]
        postures_rad = {ready = {j1 = 0.3, j2 = -0.5, j3 = 0.4}}
    """)
    words = ["collide", str(tmp_path / "satellite.toml"), "--speed", "1.0"]
    done = CliRunner().invoke(app, [*words, "--posture", "ready"])
    assert done.exit_code == 0, done.output
    reach = CliRunner().invoke(app, words)
    assert reach.exit_code == 2 and "floats freely" in reach.stderr
