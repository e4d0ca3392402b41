"""Inertias that no body can have: told all at once, repaired where one says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from support import urdfs

from impactopt import InputError, Robot
from impactopt.files.problem_file import ProblemFile
from impactopt.robots.checks import check_inertias, repair_inertias

LOST = 'ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"'
FLAT = 'ixx="0.001" iyy="0.002" izz="0.01" ixy="0" ixz="0" iyz="0"'


def _model(mass: float, moments: list[float], turn: np.ndarray | None = None) -> pin.Model:
    model, axes = pin.Model(), np.eye(3) if turn is None else turn
    joint = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "hinge")
    body = pin.Inertia.Zero()
    body.mass, body.lever = mass, np.array([0.1, 0.2, 0.3])
    body.inertia = axes @ np.diag(moments) @ axes.T
    model.inertias[joint] = body
    return model


def test_a_moment_above_the_sum_of_the_others_comes_down_to_what_matter_can_have() -> None:
    turn = np.array(pin.exp3(np.array([0.3, -0.2, 0.5])))
    model = _model(1.0, [0.001, 0.002, 0.01], turn)
    assert len(repair_inertias(model)) == 1
    body = model.inertias[1]
    assert body.mass == 1.0 and np.allclose(body.lever, [0.1, 0.2, 0.3])
    moments = np.diag(turn.T @ body.inertia @ turn)  # its axes stay
    # second moments of mass x, y, z = 0.0055, 0.0045, -0.0035: the last one becomes a slab's, 1 cm thick
    thin = 0.01**2 / 12
    assert moments == pytest.approx([0.0045 + thin, 0.0055 + thin, 0.01])


def test_a_point_becomes_a_ball() -> None:
    model = _model(3.0, [0.0, 0.0, 0.0])
    said = repair_inertias(model)
    radius = (3 * 3.0 / (4 * np.pi * 2000.0)) ** (1 / 3)
    assert np.allclose(model.inertias[1].inertia, pin.Inertia.FromSphere(3.0, radius).inertia)
    assert "'hinge'" in said[0] and "3 kg" in said[0] and "ball" in said[0]


@pytest.mark.parametrize("unit", [1e6, 1e9], ids=["kg mm2", "g mm2"])
def test_moments_in_another_unit_are_refused_and_become_those_of_a_ball(unit: float) -> None:
    true = pin.Inertia.FromBox(0.2, 0.1, 0.1, 0.2)  # [kg], [m]
    model = _model(0.2, list(unit * np.diag(true.inertia)))
    with pytest.raises(InputError, match=r"'hinge'.* g mm2"):
        check_inertias(model)
    assert "ball" in repair_inertias(model)[0]
    check_inertias(model)
    radius = (3 * 0.2 / (4 * np.pi * 2000.0)) ** (1 / 3)
    assert np.allclose(model.inertias[1].inertia, pin.Inertia.FromSphere(0.2, radius).inertia)


@pytest.mark.parametrize("moments", [[0.01, 0.02, 0.025], [0.01, 0.01, 0.02], [1e-4, 1e-4, 1e-4]])
def test_what_matter_can_have_is_left_alone(moments: list[float]) -> None:
    model = _model(1.0, moments)
    before = np.array(model.inertias[1].inertia)
    assert repair_inertias(model) == []
    assert (np.array(model.inertias[1].inertia) == before).all()


def test_what_is_repaired_is_sound_and_stays_as_it_is() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        model = _model(rng.uniform(0.01, 10), list(rng.normal(0, 0.05, 3)))
        repair_inertias(model)
        small, middle, large = np.linalg.eigvalsh(np.array(model.inertias[1].inertia))
        assert small > 0 and small + middle >= large * (1 - 1e-9)
        assert repair_inertias(model) == []


def test_all_bad_inertias_and_limits_are_told_at_once(tmp_path: Path) -> None:
    text = urdfs.biped(moments=FLAT).replace('effort="80.0"', 'effort="0"', 1)
    path = tmp_path / "walker.urdf"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        Robot.from_urdf(path)
    assert len(error.value.mistakes) == 2
    assert "'right_elbow'" in error.value.mistakes[0] and "torque limit" in error.value.mistakes[1]


def test_limits_that_a_urdf_must_have_are_named_for_all_joints(tmp_path: Path) -> None:
    """Its parser refuses the file at the first such joint, and names it only in its own output."""
    path, text = tmp_path / "walker.urdf", urdfs.biped()
    before, last = text.replace(' effort="80.0"', "", 1).rsplit("<limit ", 1)
    path.write_text(before + last[last.index("/>") + 2 :])
    with pytest.raises(InputError) as error:
        Robot.from_urdf(path)
    assert len(error.value.mistakes) == 1 and "has no <limit>; give it" in error.value.mistakes[0]


def test_a_missing_effort_is_one_of_zero(tmp_path: Path) -> None:
    """URDF requires it; other parsers read it as none, and so do files."""
    messages = []
    for effort in ("", ' effort="0"'):
        path = tmp_path / "walker.urdf"
        path.write_text(urdfs.biped().replace(' effort="80.0"', effort, 1))
        with pytest.raises(InputError, match="no usable torque limit") as error:
            Robot.from_urdf(path)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_a_joint_whose_axis_is_zero_is_named(tmp_path: Path) -> None:
    """Pinocchio reads it, and it moves nothing."""
    path = tmp_path / "arm.urdf"
    path.write_text(urdfs.arm().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'))
    with pytest.raises(InputError, match=r"'turn' has the axis 0 0 0; give its direction"):
        Robot.from_urdf(path, floating=False)


def test_a_joint_that_closes_a_loop_is_named(tmp_path: Path) -> None:
    """Pinocchio names another link, and none of the joints."""
    path, loop = (
        tmp_path / "arm.urdf",
        urdfs.joint("rod", "wrist_link", "elbow_link", "0 1 0", (0, 0, 0), (-1, 1)),
    )
    path.write_text(urdfs.arm().replace("</robot>", f"{loop}</robot>"))
    with pytest.raises(InputError, match=r"'rod' moves link 'elbow_link', as 'elbow' does; take one out"):
        Robot.from_urdf(path, floating=False)


def test_a_urdf_of_another_encoding_is_read(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    text = urdfs.arm().replace('"elbow"', '"geänderter"')
    path.write_bytes(f'<?xml version="1.0" encoding="ISO-8859-1"?>{text}'.encode("latin-1"))
    robot = Robot.from_urdf(path, floating=False, armature=0.01)
    assert "geänderter" in robot.joint_names


def test_repairs_have_to_be_said_and_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "walker.urdf"
    path.write_text(urdfs.biped(moments=LOST))
    with pytest.raises(InputError, match=r"'right_elbow'.*inertias=\"repaired\""):
        Robot.from_urdf(path)
    robot = Robot.from_urdf(path, inertias="repaired", armature=0.05)
    assert robot.source is not None
    assert [text.split("'")[1] for text in robot.source.repairs] == ["right_elbow"]
    with pytest.raises(InputError, match="there are given, repaired"):
        Robot.from_urdf(path, inertias="fixed")


def test_a_mass_is_not_guessed(tmp_path: Path) -> None:
    path = tmp_path / "walker.urdf"
    path.write_text(urdfs.biped().replace('<mass value="15.0"/>', '<mass value="-1"/>'))
    with pytest.raises(InputError, match="mass -1"):
        Robot.from_urdf(path, inertias="repaired")


def test_a_preset_has_nothing_to_repair() -> None:
    data = {
        "problem": {"striker": "fist", "point_m": [0.5, 0.0, 0.5], "normal": [1.0, 0.0, 0.0]},
        "robot": {"preset": "arm7", "inertias": "repaired"},
        "target": {"mass_kg": 1.0},
        "contact": {"stiffness_N_m": 1e4, "damping_N_s_m": 10.0},
    }
    with pytest.raises(InputError, match="inertias belongs to mjcf or urdf"):
        ProblemFile.from_data(data, Path("p.toml"))
