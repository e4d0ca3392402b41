"""Problem files drafted from a URDF or an MJCF alone, for robots written here."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from support import urdfs
from typer.testing import CliRunner

from impactopt import (
    Board,
    FreeMass,
    ImpactProblem,
    InputError,
    Nail,
    Robot,
    Slide,
    SpringDamper,
    Striker,
    Target,
    Tool,
    TorqueLimit,
    load_problem,
    optimize_strike,
    solve,
)
from impactopt.bodies.robot_bodies import bodies_of, distance, transform
from impactopt.bodies.visuals import visuals_of
from impactopt.cli.app import app
from impactopt.files.draft import strong
from impactopt.files.draft.default_drives import guess_drives
from impactopt.files.draft.drafting import Draft, draft_problem
from impactopt.files.draft.robot import Drafted, draft_robot, find_description
from impactopt.files.draft.soles import sides
from impactopt.files.draft.strikers import find_striker
from impactopt.files.draft.strong import MAX_STRIKES
from impactopt.files.toml import read_toml
from impactopt.kinematics.operational_space import striking_point
from impactopt.problem.feasibility import hopeless, sticks_out, too_weak
from impactopt.problem.plausibility import doubts
from impactopt.problem.strength import best_share
from impactopt.robots.presets import example_robots
from impactopt.robots.urdf import read_urdf

FLAT = 'ixx="0.001" iyy="0.001" izz="0.01" ixy="0" ixz="0" iyz="0"'


_drafts: dict[Any, Draft] = {}


@pytest.fixture(autouse=True)
def few_strikes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two tried strikes are enough where it does not matter how hard the drafted one is."""
    monkeypatch.setattr(strong, "MAX_STRIKES", 2)


def _drafted(folder: Path, text: str, **options: Any) -> Draft:
    """A description's draft, made once: it is the same in every folder."""
    (folder / "robot.urdf").write_text(text)
    key = text, strong.MAX_STRIKES, *sorted(options.items())
    if key not in _drafts:
        given = {"planned": False, **options}
        _drafts[key] = draft_problem(folder / "robot.urdf", folder=folder, **given)
    return _drafts[key]


def _problem(folder: Path, text: str, **options: Any) -> ImpactProblem:
    (folder / "robot.toml").write_text(_drafted(folder, text, **options).text)
    return load_problem(folder / "robot.toml")


def _robot(folder: Path, text: str) -> Drafted:
    """A description's robot, before a strike is sought for it, which takes most of a draft's time."""
    (folder / "robot.urdf").write_text(text)
    return draft_robot(folder / "robot.urdf")


def _striker(folder: Path, text: str) -> tuple[Striker, Any]:
    """The striker that a description's first arm gets, and its axis."""
    drafted = _robot(folder, text)
    return find_striker(drafted.robot.model, drafted.arms[0], "hand", drafted.pieces)


@pytest.mark.slow
def test_an_arm_beside_a_head_starts_clear_of_it(tmp_path: Path) -> None:
    """Links that touch at the start were exempt, so Baxter's forearm could begin 15 cm inside its head."""
    urdf = example_robots() / "baxter_description" / "urdf" / "baxter.urdf"
    (tmp_path / "baxter.toml").write_text(draft_problem(urdf, folder=tmp_path, planned=False).text)
    problem = load_problem(tmp_path / "baxter.toml")
    model, data = problem.robot.model, problem.robot.model.createData()
    pin.forwardKinematics(model, data, problem.start_posture)
    of_joint = bodies_of(problem.robot).of_joint
    arm = [model.getJointId(f"right_{name}") for name in ("e1", "w0", "w1", "w2")]
    pairs = [(one, two, j) for j in arm for one in of_joint.get(j, ()) for two in of_joint[0]]
    assert pairs and all(
        distance(
            one.shape,
            transform(data.oMi[j].rotation, data.oMi[j].translation),
            two.shape,
            transform(np.eye(3), np.zeros(3)),
        )
        > 0
        for one, two, j in pairs
    )


@pytest.mark.parametrize("arms", [False, True], ids=["legs", "arms"])
def test_a_biped_kicks_where_it_has_no_arms_or_is_told_to(tmp_path: Path, arms: bool) -> None:
    """From two feet to two feet, on the left one meanwhile, with the right one behind the ball."""
    problem = _problem(tmp_path, urdfs.biped(arms=arms), **({"motion": "kick"} if arms else {}))
    robot, q = problem.robot, problem.start_posture
    assert [stance.soles for stance in problem.stances] == [("left", "right"), ("left",), ("left", "right")]
    assert problem.blow == 1 and problem.striker == "right_toe" and not hopeless(problem)
    data = robot.model.createData()
    centre = pin.centerOfMass(robot.model, data, q)
    pin.framesForwardKinematics(robot.model, data, q)
    toe = data.oMf[robot.model.getFrameId("striker:right_toe")].translation
    feet = [data.oMf[robot.model.getFrameId(sole.frame)].translation for sole in problem.soles]
    assert np.abs([foot[2] for foot in feet]).max() < 1e-6
    assert abs(centre[0] - np.mean(feet, axis=0)[0]) < 0.05 and abs(centre[1]) < 0.01
    assert toe[0] < problem.point[0] - 0.05 and toe[1] == pytest.approx(problem.point[1], abs=1e-3)


def test_a_foot_that_is_longer_than_its_sole_kicks_with_its_toe(tmp_path: Path) -> None:
    """And stands on both feet before that, with ankles too weak for one of them at the start."""
    low, high, ahead = 0.03, 0.06, 0.04
    at = (0.04 + ahead, 0.0, -urdfs.ANKLE + (low + high) / 2)
    shape = f'<geometry><box size="{urdfs.SOLE[0]} {urdfs.SOLE[1]} {high - low}"/></geometry>'
    cap = f'<collision><origin xyz="{" ".join(map(str, at))}"/>{shape}</collision>'
    name = '<link name="right_ankle_roll_link">'
    text = urdfs.biped(arms=False).replace(name, name + cap)
    problem = _problem(tmp_path, text)
    robot, data = problem.robot, problem.robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, problem.start_posture)
    toe, sole = (data.oMf[robot.model.getFrameId(f)] for f in ("striker:right_toe", "right_sole"))
    forward = problem.soles[-1].polygon[:, 0].max() + ahead
    assert sole.actInv(toe.translation) == pytest.approx([forward, 0.0, low], abs=1e-4)
    assert sticks_out(problem) == []
    weight = 9.81 * sum(body.mass for body in robot.model.inertias)
    aside = abs(data.oMi[robot.model.getJointId("left_ankle_roll")].translation[1])
    share = 0.9 * weight * aside / robot.torque_limit.max()  # of the limit, 0.9 of what the roll joint needs
    others = (term for term in problem.terms if not isinstance(term, TorqueLimit))
    assert too_weak(dataclasses.replace(problem, terms=(*others, TorqueLimit(fraction=share)))) == ""


def test_a_punch_on_legs_may_not_slide_off_the_target_from_the_start(tmp_path: Path) -> None:
    assert _problem(tmp_path, urdfs.biped()).extra(Slide) == Slide()


def test_who_cannot_kick_or_punch_is_told(tmp_path: Path) -> None:
    for text, motion, why in (
        (urdfs.arm(), "kick", "does not stand on legs"),
        (urdfs.biped(arms=False), "punch", "no limb beside the legs"),
        (urdfs.biped(legs=5, arms=False), None, "would swing on its hinge; bolt it to the ground"),
        (urdfs.biped(legs=5), "kick", "would swing on its hinge; let it punch"),
        (urdfs.biped(arms=False), "nail", "no limb beside the legs to nail with"),
        (urdfs.arm(), "slap", "give punch, kick, chop or nail"),
    ):
        with pytest.raises(InputError, match=why):
            _drafted(tmp_path, text, motion=motion)


def test_a_bolted_robot_with_arms_and_legs_strikes_with_an_arm(tmp_path: Path) -> None:
    """Its legs have more joints than its arms; where there are no arms, it strikes with a leg."""
    for arms, length in ((True, 3), (False, 6)):
        (tmp_path / "robot.urdf").write_text(urdfs.biped(arms=arms))
        bolted = draft_robot(tmp_path / "robot.urdf", bolted=True)
        assert [len(limb.own) for limb in bolted.arms] == [length, length]


@pytest.mark.slow
def test_legs_that_hang_below_the_ground_when_bolted_are_told(tmp_path: Path) -> None:
    """The message was only that no target is found. On a mount of a metre there is one."""
    text = urdfs.biped(arms=False)
    with pytest.raises(
        InputError, match=r"'right_hand' hangs 0.88 m below the ground; place the root higher"
    ):
        _drafted(tmp_path, text, bolted=True)


def test_an_arm_in_millimetres_has_no_posture_and_is_told_why(tmp_path: Path) -> None:
    def scaled(found: re.Match[str]) -> str:
        return f'{found[1]}="{" ".join(str(1e3 * float(x)) for x in found[2].split())}"'

    text = re.sub(r'((?<!axis )xyz|size)="([^"]*)"', scaled, urdfs.arm())
    with pytest.raises(InputError, match=r"millimetres.*no posture is found"):
        _drafted(tmp_path, text)


def test_knees_without_a_range_are_named_where_no_posture_is_found(tmp_path: Path) -> None:
    knee = r'(<joint name="[^"]*knee".*?)lower="[^"]*" upper="[^"]*"'
    text = re.sub(knee, r'\1lower="0" upper="0"', urdfs.biped(), flags=re.DOTALL)
    with pytest.raises(InputError, match=r"without a range, locked: left_knee, right_knee; no posture"):
        _drafted(tmp_path, text)


def test_lost_meshes_of_feet_are_named_where_no_posture_is_found(tmp_path: Path) -> None:
    # the box of a foot's inertia, which stands for its shape, is inclined sideways: without ankle roll no
    # posture has it level
    foot = r'(_ankle_pitch_link">.*?)<inertia [^>]*/>(.*?)<box [^>]*/>'
    moments = 'ixx="0.002" iyy="0.004" izz="0.004" ixy="0" ixz="0" iyz="0.001"'
    leaning = rf'\1<inertia {moments}/>\2<mesh filename="foot.stl"/>'
    text = re.sub(foot, leaning, urdfs.biped(without="ankle_roll"), flags=re.DOTALL)
    with pytest.raises(InputError, match=r"foot\.stl: not found; put .*; no posture with level soles"):
        _drafted(tmp_path, text)


def test_a_robot_whose_knees_point_back_has_its_right_foot_on_its_right(tmp_path: Path) -> None:
    knee = r'(<joint name="[^"]*knee".*?)lower="[^"]*" upper="[^"]*"'
    text = re.sub(knee, r'\1lower="-2.2" upper="0"', urdfs.biped(arms=False), flags=re.DOTALL)
    kick = read_toml(_drafted(tmp_path, text, motion="kick").text)["problem"]
    assert kick["striker"] == "right_toe" and kick["point_m"][1] < 0


@pytest.mark.slow
def test_a_kick_in_place_of_a_punch_is_told_with_the_reason(tmp_path: Path) -> None:
    text = urdfs.biped()
    for joint, low, high in (("shoulder_pitch", 1.2, 2.8), ("elbow", -0.2, 0.0)):  # arms stay behind
        limits = rf'(<joint name="[^"]*{joint}".*?)lower="[^"]*" upper="[^"]*"'
        text = re.sub(limits, rf'\1lower="{low}" upper="{high}"', text, flags=re.DOTALL)
    with pytest.raises(InputError) as no_punch:
        _drafted(tmp_path, text, motion="punch")
    draft = _drafted(tmp_path, text)
    assert read_toml(draft.text)["problem"]["striker"] == "right_toe"
    assert draft.said[-1] == f"a kick is drafted, as there is no punch: {no_punch.value}"


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["punch", "nail"])
def test_a_robot_whose_one_joint_moves_no_striking_point_is_told(tmp_path: Path, motion: str) -> None:
    text = urdfs.arm()
    for name in ("shoulder", "elbow", "wrist"):
        text = text.replace(f'<joint name="{name}" type="revolute">', f'<joint name="{name}" type="fixed">')
    with pytest.raises(InputError, match="no posture is found with 'hand' in front"):
        _drafted(tmp_path, text, motion=motion)


@pytest.mark.slow
def test_a_ram_is_told_that_drafted_nails_are_struck_from_above(tmp_path: Path) -> None:
    """It could drive one ahead, in a file drafted without a motion; the message named no direction."""
    body, ram = (urdfs.link(name, 2.0, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)) for name in ("base", "ram"))
    slide = urdfs.joint("slide", "base", "ram", "1 0 0", (0.0, 0.0, 1.0), (-3.0, 3.0), kind="prismatic")
    with pytest.raises(
        InputError, match=r"from above, as drafted nails .* without --motion, .* 30 N for each kg"
    ):
        _drafted(tmp_path, urdfs.robot("ram", body, ram, slide), motion="nail")


def test_a_hand_waits_ahead_of_its_shoulder_wherever_on_its_axis_a_joint_is_given(tmp_path: Path) -> None:
    """The same robot, with the frames of both first shoulder joints in the middle of the trunk."""
    text = moved = urdfs.biped()
    for y in ("0.", "-0."):
        for old, new in ((f"{y}2 0.4", "0.0 0.4"), (f"{y}05 0.0", f"{y}25 0.0")):
            assert f'<origin xyz="0.0 {old}"/>' in moved
            moved = moved.replace(f'<origin xyz="0.0 {old}"/>', f'<origin xyz="0.0 {new}"/>')
    there = [
        striking_point(problem.robot, problem.striker, problem.start_posture)
        for problem in (_problem(tmp_path, text), _problem(tmp_path, moved))
    ]
    assert there[0][1] < -0.15 and there[1] == pytest.approx(there[0], abs=0.02)


def test_a_hand_waits_ahead_of_its_shoulder_wherever_a_joint_rolls_the_upper_arm(tmp_path: Path) -> None:
    """The same motions of an upper arm that turns at the shoulder, and of one that is split in the middle."""
    there = []
    for split in (0.0, 0.14):
        arm = (
            ("shoulder_pitch", "0 1 0", (0.0, 0.0, 0.4), (-2.8, 2.8), 0.05),
            ("shoulder_roll", "1 0 0", (0.0, 0.25, 0.0), (-1.5, 1.5), 0.1),
            ("upper_roll", "0 0 1", (0.0, 0.0, -split), (-1.5, 1.5), 0.1),
            ("elbow", "0 1 0", (0.0, 0.0, split - 0.28), (-2.4, 0.0), 0.25),
            ("wrist", "0 0 1", (0.0, 0.0, -0.3), (-1.5, 1.5), 0.1),
        )
        problem = _problem(tmp_path, urdfs.biped(arm=arm))
        there.append(striking_point(problem.robot, problem.striker, problem.start_posture))
    assert there[0][1] < -0.15 and there[1] == pytest.approx(there[0], abs=0.02)


@pytest.mark.slow
def test_an_elbow_that_drives_no_nail_is_told_why_its_strikes_fail(tmp_path: Path) -> None:
    """A posture in front, which its one joint has not either, is not what it lacks."""
    parts = [
        urdfs.link("base", 1.0, (0.1, 0.1, 0.1), (0.0, 0.0, 0.05)),
        urdfs.link("forearm", 1.5, (0.3, 0.06, 0.06), (0.15, 0.0, 0.0)),
    ]
    parts += [urdfs.joint("elbow", "base", "forearm", "0 1 0", (0.0, 0.0, 0.5), (-1.5, 1.5), effort=40.0)]
    elbow = urdfs.robot("elbow", *parts)
    with pytest.raises(InputError, match=r"no strike of 'hand' is found; .*[Cc]onstraints"):
        _drafted(tmp_path, elbow, motion="nail")
    assert optimize_strike(_problem(tmp_path, elbow)).status.usable


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "motion", "kind"),
    [(urdfs.arm(), "nail", Nail), (urdfs.biped(), "chop", Board)],
    ids=["arm", "biped"],
)
def test_boards_and_nails_are_hit_from_above(
    tmp_path: Path, text: str, motion: str, kind: type[Target]
) -> None:
    """From a start above them, and a biped with the side of its hand that is below then."""
    problem = _problem(tmp_path, text, motion=motion)
    robot, q = problem.robot, problem.start_posture
    assert isinstance(problem.target, kind) and not hopeless(problem)
    assert problem.normal.tolist() == [0.0, 0.0, -1.0]
    data, frame = robot.model.createData(), robot.model.getFrameId(f"striker:{problem.striker}")
    pin.framesForwardKinematics(robot.model, data, q)
    assert data.oMf[frame].translation[2] > problem.point[2] + 0.05
    if robot.soles:
        assert problem.striker == "right_edge"
    assert optimize_strike(problem).status.usable


@pytest.mark.parametrize("behind", [False, True], ids=["ahead", "behind"])
def test_a_biped_stands_on_the_soles_of_its_feet(tmp_path: Path, behind: bool) -> None:
    problem = _problem(tmp_path, urdfs.biped(behind=behind))
    robot = problem.robot
    assert [sole.name for sole in robot.soles] == ["left", "right"]
    length, width = urdfs.SOLE
    for sole in robot.soles:  # the box, 4 cm ahead of the ankle, whichever way the root looks
        assert sole.polygon.min(axis=0) == pytest.approx([0.04 - length / 2, -width / 2], abs=1e-4)
        assert sole.polygon.max(axis=0) == pytest.approx([0.04 + length / 2, width / 2], abs=1e-4)
        assert sole.placement.translation == pytest.approx([0.0, 0.0, -urdfs.ANKLE], abs=1e-4)
    robot.check_stance(problem.start_posture)
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, problem.start_posture)
    left, right = (data.oMf[robot.model.getFrameId(sole.frame)] for sole in robot.soles)
    assert left.translation[1] > 0 > right.translation[1]
    for side in ("left", "right"):  # knees bend to the front
        knee, hip = (data.oMi[robot.model.getJointId(f"{side}_{name}")] for name in ("knee", "hip_pitch"))
        assert knee.translation[0] > hip.translation[0] + 0.05


def test_weak_ankles_carry_the_start_posture(tmp_path: Path) -> None:
    """Above the soles' middle, 4 cm ahead of the ankles, each would need 8 N m."""
    strong = urdfs.biped()
    weak = re.sub(r'(name="\w+_ankle_pitch".*?effort=)"80.0"', r'\1"5.0"', strong, flags=re.DOTALL)
    ahead = []
    for text in (strong, weak):
        problem = _problem(tmp_path, text)
        robot, q = problem.robot, problem.start_posture
        data = robot.model.createData()
        centre = pin.centerOfMass(robot.model, data, q)
        ahead.append(float((centre - data.oMi[robot.model.getJointId("left_ankle_pitch")].translation)[0]))
        assert too_weak(problem) == ""
    assert robot.torque_limit[robot.joint_index("left_ankle_pitch")] == 5.0
    assert 0.0 < ahead[1] < 0.025 < ahead[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "text", [urdfs.biped(), urdfs.arm(), urdfs.arm(wheels=True)], ids=["biped", "arm", "cart"]
)
def test_what_is_drafted_is_sound(tmp_path: Path, text: str) -> None:
    problem = _problem(tmp_path, text)
    assert hopeless(problem) == [] and doubts(problem.robot) == []
    data = problem.robot.model.createData()
    pin.framesForwardKinematics(problem.robot.model, data, problem.start_posture)
    at = data.oMf[problem.robot.model.getFrameId(f"striker:{problem.striker}")].translation
    assert problem.normal @ (problem.point - at) > 0.05  # room to swing


@pytest.mark.parametrize(
    ("shape", "hinge"),
    [
        ({"legs": 7}, None),
        ({"waist": True}, None),
        pytest.param({"legs": 7, "waist": True}, None, marks=pytest.mark.slow),
        ({"without": "ankle_roll"}, "x"),
        ({"without": "hip_yaw"}, "z"),
        pytest.param({"without": "ankle_roll", "waist": True}, "x", marks=pytest.mark.slow),
    ],
    ids=["seven", "waist", "seven and waist", "no ankle roll", "no hip yaw", "five and waist"],
)
def test_legs_of_five_and_seven_and_a_waist_stand(
    tmp_path: Path, shape: dict[str, Any], hinge: str | None
) -> None:
    draft = _drafted(tmp_path, text := urdfs.biped(**shape))
    data = read_toml(draft.text)
    assert [sole.get("hinge") for sole in data["robot"]["soles"]] == [hinge, hinge]
    assert "locked_rad" not in data["robot"]
    problem = _problem(tmp_path, text)
    assert hopeless(problem) == [] and doubts(problem.robot) == []
    robot = problem.robot
    robot.check_stance(problem.start_posture, tilt=1e-5)
    knees = robot.joint_positions(problem.start_posture)[
        [robot.joint_index("left_knee"), robot.joint_index("right_knee")]
    ]
    assert (knees > 0.3).all()
    extra = (shape.get("legs") == 7) + (shape.get("waist") is True)
    assert [leg.before.size for leg in problem.coordinates.legs] == [extra, extra]


@pytest.mark.parametrize("text", [urdfs.biped(), urdfs.arm()], ids=["biped", "arm"])
def test_the_contact_of_a_light_target_has_the_damping_ratio_of_the_papers(tmp_path: Path, text: str) -> None:
    """The paper's: 300 N s/m, 1e4 N/m, 5 kg."""
    problem = _problem(tmp_path, text)
    law, target = problem.law, problem.target
    assert isinstance(law, SpringDamper) and isinstance(target, FreeMass) and target.mass < 4.0
    ratio = law.damping / np.sqrt(law.stiffness * target.mass)
    assert ratio == pytest.approx(300.0 / np.sqrt(1e4 * 5.0), rel=0.05)  # written with two digits


def test_a_hinge_is_in_the_middle_of_a_foot_that_is_inside_of_its_ankle(tmp_path: Path) -> None:
    """Poppy's ankles are above the outer edges of its feet: there, no pressure keeps the margin."""
    text = urdfs.biped(without="ankle_roll", inward=0.045)
    robot = _problem(tmp_path, text).robot
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.posture("ready"))
    for sole in robot.soles:
        assert sole.polygon.min(axis=0) == pytest.approx(-sole.polygon.max(axis=0), abs=1e-3)
        ankle, middle = (
            data.oMf[robot.model.getFrameId(name)].translation
            for name in (f"{sole.name}_ankle_pitch_link", sole.frame)
        )
        assert abs(middle[1]) == pytest.approx(abs(ankle[1]) - 0.045, abs=1e-3)


def test_a_leg_of_five_stands_whose_axes_have_rounded_decimals(tmp_path: Path) -> None:
    """Five joints meet six constraints exactly only if all axes are."""
    text = urdfs.biped(without="ankle_roll")
    text, count = re.subn(r'(name="\w+_knee".*?<axis xyz=")0.0 1.0 0.0', r"\g<1>1e-6 1.0 1e-6", text)
    assert count == 2
    problem = _problem(tmp_path, text)
    problem.robot.check_stance(problem.start_posture, tilt=2e-5)


def test_two_hands_beside_a_tail_are_a_left_and_a_right_one(tmp_path: Path) -> None:
    ends = {"l_palm": 0.2, "r_palm": -0.2, "tail": 0.0}
    parts = [urdfs.link("torso", 5.0, (0.2, 0.3, 0.4), (0.0, 0.0, 0.2))]
    for name, y in ends.items():
        parts += [urdfs.link(name, 1.0, (0.05, 0.05, 0.3), (0.0, 0.0, -0.15))]
        parts += [urdfs.joint(f"swing_{name}", "torso", name, "0 1 0", (0.0, y, 0.3), (-1.0, 1.0))]
    (tmp_path / "robot.urdf").write_text(urdfs.robot("monkey", *parts))
    model = read_urdf(tmp_path / "robot.urdf", floating=False).model
    tips = [model.getJointId(f"swing_{name}") for name in ends]
    assert sides(model, tips) == ["left", "right", "tail"]
    assert sides(model, [tips[0], tips[0], tips[1]]) == ["l_palm", "l_palm", "r_palm"]


def test_toes_are_locked(tmp_path: Path) -> None:
    x, _ = urdfs.SOLE
    toes = [
        urdfs.link(f"{side}_toe_link", 0.2, (0.06, 0.1, 0.04), (0.03, 0.0, -0.02))
        + urdfs.joint(
            f"{side}_toe",
            f"{side}_ankle_roll_link",
            f"{side}_toe_link",
            "0 1 0",
            (0.04 + x / 2, 0.0, -urdfs.ANKLE + 0.04),
            (-0.5, 0.5),
        )
        for side in ("left", "right")
    ]
    text = urdfs.biped().replace("</robot>", "".join(toes) + "</robot>")
    assert set(_robot(tmp_path, text).locked) == {"left_toe", "right_toe"}


def test_a_joint_without_a_motor_in_a_leg_of_seven_is_locked(tmp_path: Path) -> None:
    """With it, four axes of the leg's last six are parallel, so these cannot hold a sole."""
    text = urdfs.biped()
    for side in ("left", "right"):
        text = text.replace(
            f'<parent link="{side}_knee_link"/><child', f'<parent link="{side}_tarsus_link"/><child'
        )
        at = (0.0, 0.0, -0.2)
        tarsus = urdfs.link(f"{side}_tarsus_link", 0.5, (0.05, 0.05, 0.1), (0.0, 0.0, -0.05)) + urdfs.joint(
            f"{side}_tarsus", f"{side}_knee_link", f"{side}_tarsus_link", "0 1 0", at, (-0.9, 1.2), effort=0.0
        )
        text = text.replace("</robot>", tarsus + "</robot>")
    problem = _problem(tmp_path, text)
    data = read_toml((tmp_path / "robot.toml").read_text())["robot"]
    assert data["locked_rad"] == {"left_tarsus": 0.0, "right_tarsus": 0.0}
    # which the file does not say: an effort of 0 is as often one that nobody has filled in
    (said,) = [line for line in _drafted(tmp_path, text).said if line.startswith("locked: ")]
    assert "the file has no effort: else unlock it, with torque_limit_N_m (2 joints)" in said
    assert "torque_limit_N_m" not in data
    problem.robot.check_stance(problem.start_posture, tilt=1e-5)


def test_a_knee_whose_torque_is_not_believed_has_a_motor(tmp_path: Path) -> None:
    """It was locked in a leg of seven, as one without a motor, and nothing was said of its limit."""
    text = re.sub(r'(<joint name="\w+_knee".*?effort=")[^"]*', r"\g<1>20000", urdfs.biped(legs=7), flags=re.S)
    drafted = _robot(tmp_path, text)
    assert drafted.locked == {} and set(drafted.drives.torque) == {"left_knee", "right_knee"}
    assert "torque limit of left_knee, 20000 N m: hard to believe, and guessed" in drafted.drives.said


@pytest.mark.parametrize("spine", [True, False], ids=["spine", "torso"])
def test_arms_that_hang_from_a_spine_or_end_in_wrists_are_no_legs(tmp_path: Path, spine: bool) -> None:
    parts = [urdfs.link("chest", 5.0, (0.2, 0.3, 0.2), (0.0, 0.0, 0.1))]
    if spine:
        parts.insert(0, urdfs.link("pelvis", 5.0, (0.2, 0.2, 0.1), (0.0, 0.0, 0.0)))
        parts.append(urdfs.joint("spine", "pelvis", "chest", "0 0 1", (0.0, 0.0, 0.05), (-1.0, 1.0)))
    for side, y in (("left", 0.2), ("right", -0.2)):
        parent, chain = (
            "chest",
            (
                ("shoulder_pitch", "0 1 0", (0.0, y, 0.2), 0.05),
                ("shoulder_roll", "1 0 0", (0.0, 0.0, 0.0), 0.3),
                ("elbow" if spine else "wrist", "0 1 0", (0.0, 0.0, -0.3), 0.3),
            ),
        )
        for name, axis, at, long in chain:
            child = f"{side}_{name}_link"
            parts += [urdfs.link(child, 1.0, (0.06, 0.06, long), (0.0, 0.0, -long / 2))]
            parts += [urdfs.joint(f"{side}_{name}", parent, child, axis, at, (-2.0, 2.0))]
            parent = child
    drafted = _robot(tmp_path, urdfs.robot("chest", *parts))
    assert not drafted.robot.floating and not drafted.legs


def test_fingers_and_wheels_are_locked_and_a_cart_is_bolted(tmp_path: Path) -> None:
    data = read_toml(_drafted(tmp_path, urdfs.arm(wheels=True)).text)
    assert set(data["robot"]["locked_rad"]) == {"slide_0", "slide_1", "drive_0", "drive_1"}
    assert data["robot"]["floating"] is False


def test_a_bolted_base_counts_as_one_that_is_not_given_as_bolted(tmp_path: Path) -> None:
    """Nameless fingers are told by their share of the robot's mass, of which a base may have the most."""
    small, text = '<mass value="0.03"/>', urdfs.arm()
    assert text.count(small) == 2
    path = tmp_path / "robot.urdf"
    path.write_text(text.replace(small, '<mass value="0.3"/>'))  # 1.6 % of all, 3.5 % of what moves
    for bolted in (False, True):
        assert set(draft_robot(path, bolted=bolted).locked) == {"slide_0", "slide_1"}


def test_a_robot_that_is_a_finger_moves(tmp_path: Path) -> None:
    named = urdfs.arm()
    for joint in re.findall(r'<joint name="(\w+)" type="revolute"', named):
        named = named.replace(f'"{joint}"', f'"finger_{joint}"')
    assert not any("finger_" in joint for joint in _robot(tmp_path, named).locked)


def test_a_striker_is_at_the_end_of_its_link(tmp_path: Path) -> None:
    data = read_toml(_drafted(tmp_path, urdfs.arm()).text)
    (striker,) = data["robot"]["strikers"]
    assert striker["frame"] == "wrist_link" and striker["point_m"] == [0.0, 0.0, 0.15]  # the claws' tips


@pytest.mark.slow
@pytest.mark.parametrize("ball", [0.04, 0.2])
def test_of_a_forearm_with_a_ball_for_a_collision_shape_the_drawn_end_strikes(
    tmp_path: Path, ball: float
) -> None:
    """Files for reinforcement learning have a small ball there; a large one is the robot's own."""
    box = '<geometry><box size="0.08 0.08 0.3"/></geometry>'
    shapes = f'<collision><geometry><sphere radius="{ball}"/></geometry></collision>'
    seen = f'<visual><origin xyz="0 0 0.15"/>{box}</visual>'
    head, forearm, tail = urdfs.arm().partition('<link name="elbow_link">')
    forearm = re.sub(r"<collision>.*?</collision>", shapes + seen, forearm + tail, count=1)
    text = re.sub(r'<link name="(wrist_link|claw_\d)">.*?</link>', "", head + forearm)
    text = re.sub(r'<joint name="(wrist|slide_\d)".*?</joint>', "", text)
    (striker,) = read_toml(_drafted(tmp_path, text).text)["robot"]["strikers"]
    assert striker["frame"] == "elbow_link"
    assert striker["point_m"] == pytest.approx([0.0, 0.0, 0.3 if ball < 0.1 else ball], abs=1e-3)


def _strike(problem: ImpactProblem) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solved = optimize_strike(problem)
    return solved.impulse if solved.status.usable else 0.0


@pytest.mark.slow
def test_a_bolted_arm_hits_where_it_is_strong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At least 0.8 of the best of 20 strikes elsewhere, at points and normals that are drawn here."""
    monkeypatch.setattr(strong, "MAX_STRIKES", MAX_STRIKES)
    problem = _problem(tmp_path, urdfs.arm())
    assert problem.near_contact == "contact", "its posture, from which plans of the file start"
    drafted, model = _strike(problem), problem.robot.model
    rng, data, elsewhere = np.random.default_rng(1), model.createData(), []
    frame = model.getFrameId(f"striker:{problem.striker}")
    while len(elsewhere) < 20:
        q = rng.uniform(problem.robot.lower, problem.robot.upper)
        pin.framesForwardKinematics(model, data, q)
        point, normal = np.array(data.oMf[frame].translation), np.eye(3)[rng.integers(3)]
        normal = normal * (1.0 if normal[0] else rng.choice([-1.0, 1.0]))
        if point[0] < 0.2 or point[2] < 0.1:
            continue
        try:
            elsewhere.append(_strike(dataclasses.replace(problem, point=point, normal=normal)))
        except InputError:  # out of reach with all joints inside, or the start is in the target
            continue
    assert drafted > 0.8 * max(elsewhere) > 0
    found = best_share(problem)
    assert found is not None and found[0] > 0.6


def _two_arms() -> str:
    """Two arms that lie level in the zero posture, which their shoulders cannot bear, and a head."""
    parts = [urdfs.link("base", 30.0, (0.3, 0.3, 0.8), (0.0, 0.0, 0.4))]
    for side, y in (("left", 0.35), ("right", -0.35)):
        parent = "base"
        for name, axis, at, long in (
            ("turn", "0 0 1", (0.0, y, 0.9), 0.05),
            ("lift", "0 1 0", (0.05, 0.0, 0.0), 0.3),
            ("elbow", "0 1 0", (0.3, 0.0, 0.0), 0.3),
            ("wrist", "0 1 0", (0.3, 0.0, 0.0), 0.1),
        ):
            child = f"{side}_{name}_link"
            parts += [urdfs.link(child, 6 * long, (long, 0.06, 0.06), (long / 2, 0.0, 0.0))]
            parts += [urdfs.joint(f"{side}_{name}", parent, child, axis, at, (-2.2, 2.2), effort=12.0)]
            parent = child
    parts += [urdfs.link("head", 1.0, (0.1, 0.1, 0.1), (0.0, 0.0, 0.1))]
    parts += [urdfs.joint("head_pan", "base", "head", "0 0 1", (0.0, 0.0, 0.9), (-1.0, 1.0))]
    return urdfs.robot("two arms", *parts)


@pytest.mark.slow
def test_a_target_does_not_fly_into_the_base(tmp_path: Path) -> None:
    """A wide plate below the arm: what is hit down lands on it within the follow-through."""
    plate = urdfs.link("base", 10.0, (2.4, 2.4, 0.1), (0.0, 0.0, 0.25))
    text = re.sub(r'<link name="base">.*?</link>', plate, urdfs.arm())
    problem = _problem(tmp_path, text)
    assert problem.normal[2] == 0 and not hopeless(problem)


@pytest.mark.slow
def test_a_telescope_that_reaches_to_a_side_strikes_there(tmp_path: Path) -> None:
    """Its slides are shorter than a usual run-up, and nothing is within reach ahead of its base."""
    slide = {"kind": "prismatic", "effort": 100.0, "velocity": 1.0}
    parts = [
        urdfs.link("mast", 15.0, (0.2, 0.2, 1.0), (0.0, 0.0, 0.5)),
        urdfs.link("lift", 2.0, (0.08, 0.08, 0.08), (-0.1, -0.16, 0.0)),
        urdfs.joint("rise", "mast", "lift", "0 0 1", (0.0, 0.0, 0.2), (0.0, 0.7), **slide),
    ]
    parent = "lift"
    for k in range(3):
        parts += [urdfs.link(f"tube_{k}", 0.3, (0.05, 0.02, 0.05), (-0.1, -0.22 - 0.03 * k, 0.0))]
        parts += [urdfs.joint(f"slide_{k}", parent, f"tube_{k}", "0 -1 0", (0, 0, 0), (0.0, 0.13), **slide)]
        parent = f"tube_{k}"
    parts += [urdfs.link("hand", 0.3, (0.05, 0.1, 0.05), (0.0, -0.05, 0.0))]
    parts += [urdfs.joint("wrist", parent, "hand", "0 0 1", (-0.1, -0.32, 0.0), (-1.0, 1.0), effort=5.0)]
    draft = _drafted(tmp_path, urdfs.robot("stretcher", *parts))
    assert any("the drafted strike, along [0, -1, 0] (to the right)" in line for line in draft.said)
    assert "in which the target is pushed: to the right\n" in draft.text
    (tmp_path / "robot.toml").write_text(draft.text)
    problem = load_problem(tmp_path / "robot.toml")
    assert hopeless(problem) == [] and problem.point[1] < -0.3


@pytest.mark.slow
def test_of_two_arms_the_other_one_waits_where_its_motors_hold_it(tmp_path: Path) -> None:
    draft = _drafted(tmp_path, _two_arms(), planned=True)
    said = next(line for line in draft.said if "that have a whole motion" in line)
    said, _, more = said.partition("; ")
    assert more == "`solve --starts 8` may find a harder motion"
    (tmp_path / "robot.toml").write_text(draft.text)
    problem = load_problem(tmp_path / "robot.toml")
    robot, q = problem.robot, problem.start_posture
    assert "head_pan" not in robot.joint_names and problem.striker == "right_hand"
    weight, asked = (
        np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), posture))
        for posture in (np.zeros(robot.nq), q)
    )
    left = [k for k, name in enumerate(robot.joint_names) if name.startswith("left")]
    assert (weight > robot.torque_limit)[left].any() and (asked <= 0.6 * robot.torque_limit)[left].all()
    solution = solve(problem)
    assert solution.status.usable
    assert float(said.split()[-3]) == pytest.approx(solution.impulse, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("still", [("turn", "wrist"), ("wrist",)])
def test_an_arm_of_few_joints_strikes(tmp_path: Path, still: tuple[str, ...]) -> None:
    """It cannot turn its hand at will: with the hand's face, or else with what comes first."""
    text = urdfs.arm()
    for name in still:
        text = text.replace(f'<joint name="{name}" type="revolute">', f'<joint name="{name}" type="fixed">')
    draft = _drafted(tmp_path, text)
    assert any("the hardest of those tried" in line for line in draft.said)
    off = "first_touch" in read_toml(draft.text).get("terms", {})
    assert off == any("first_touch" in line for line in draft.said)


@pytest.mark.slow
def test_an_arm_in_a_plane_near_the_ground_strikes(tmp_path: Path) -> None:
    """Two joints about vertical axes, with links at a height of 10 cm; not so below the ground."""
    box, limits = (0.5, 0.06, 0.04), (-2.5, 2.5)
    text = urdfs.robot(
        "planar",
        urdfs.link("base", 1.0, (0.1, 0.1, 0.04), (0.0, 0.0, 0.02)),
        urdfs.link("upper", 1.0, box, (0.25, 0.0, 0.0)),
        urdfs.link("lower", 1.0, box, (0.25, 0.0, 0.05)),
        urdfs.joint("shoulder", "base", "upper", "0 0 1", (0.0, 0.0, 0.06), limits),
        urdfs.joint("elbow", "upper", "lower", "0 0 1", (0.5, 0.0, 0.0), limits),
    )
    draft = _drafted(tmp_path, text)
    assert any("the hardest of those tried" in line for line in draft.said)
    with pytest.raises(InputError, match=r"'hand' hangs 0.35 m below the ground; place the root higher"):
        _drafted(tmp_path, text.replace('xyz="0.0 0.0 0.06"', 'xyz="0.0 0.0 -0.35"'))


@pytest.mark.slow
def test_a_weak_blow_is_told_as_such(tmp_path: Path) -> None:
    problem = _problem(tmp_path, urdfs.arm())
    strong = best_share(problem)
    weak = best_share(dataclasses.replace(problem, normal=np.array([1.0, 0.0, 0.0])))
    assert strong is not None and weak is not None and problem.normal[0] != 1.0
    assert weak[0] < strong[0] and weak[1].normal[0] != 1.0
    done = CliRunner().invoke(app, ["check", str(tmp_path / "robot.toml")])
    assert f"{100 * strong[0]:.0f} % of the hardest impact nearby" in done.output


@pytest.mark.slow
@pytest.mark.parametrize("velocity", [0.3, 4.0])
def test_phases_last_as_long_as_slow_joints_need(tmp_path: Path, velocity: float) -> None:
    problem = _problem(tmp_path, urdfs.arm(velocity=velocity))
    robot = problem.robot
    way = robot.joint_positions(problem.contact_posture) - robot.joint_positions(problem.start_posture)
    needed = float(np.max(np.abs(way) / robot.velocity_limit))
    for phase in (problem.swing, problem.follow):
        assert phase.duration[1] > 1.2 * needed
    if velocity == 0.3:
        assert solve(problem, refine=False).status.usable


def _flange(tool: str = "", *, axis: str = "0 0 1") -> str:
    """An arm of four joints and a flange, whose shape is behind its frame; tool : more links."""
    parts, parent = [urdfs.link("base", 10.0, (0.3, 0.3, 0.4), (0.0, 0.0, 0.2))], "base"
    for name, turn, z, long in (
        ("turn", "0 0 1", 0.4, 0.1),
        ("shoulder", "0 1 0", 0.1, 0.3),
        ("elbow", "0 1 0", 0.3, 0.3),
        ("wrist", "0 1 0", 0.3, 0.1),
    ):
        parts += [urdfs.link(f"{name}_link", 2.0, (0.08, 0.08, long), (0.0, 0.0, long / 2))]
        parts += [urdfs.joint(name, parent, f"{name}_link", turn, (0.0, 0.0, z), (-2.2, 2.2))]
        parent = f"{name}_link"
    parts += [urdfs.link("flange", 0.2, (0.07, 0.07, 0.03), (0.0, 0.0, -0.015))]
    parts += [urdfs.joint("roll", parent, "flange", axis, (0.0, 0.0, 0.13), (-2.2, 2.2))]
    return urdfs.robot("flanged", *parts, tool)


def _fixed(parent: str, child: str, place: str) -> str:
    return (
        f'<link name="{child}"/><joint name="{child}_fixed" type="fixed"><parent link="{parent}"/>'
        f'<child link="{child}"/><origin {place}/></joint>'
    )


@pytest.mark.parametrize("axis", ["0 0 1", "0 1 0"], ids=["rolls", "pitches"])
def test_of_a_flange_behind_its_frame_the_face_away_from_the_arm_strikes(tmp_path: Path, axis: str) -> None:
    striker, _ = _striker(tmp_path, _flange(axis=axis))
    assert striker.frame == "flange" and striker.point == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "place", "point"),
    [
        ("tool0", 'xyz="0 0 0"', [0.0, 0.0, 0.0]),
        ("gripper_tcp", 'xyz="0 0 0.12"', [0.0, 0.0, 0.0]),
        ("link_eef", 'xyz="0 0 0.05" rpy="0 -1.5707963267948966 0"', [0.0, 0.0, 0.0]),
        ("tool0", 'xyz="0 0 -0.02"', [0.0, 0.0, 0.02]),  # the flange's face is ahead of it
    ],
)
def test_a_tool_frame_wins_over_shapes(tmp_path: Path, name: str, place: str, point: list[float]) -> None:
    striker, _ = _striker(tmp_path, _flange(_fixed("flange", name, place)))
    assert striker.frame == name and striker.point == pytest.approx(point, abs=1e-6)


@pytest.mark.parametrize("tool", [False, True])
def test_a_hand_without_shapes_reaches_to_its_centre_of_mass(tmp_path: Path, tool: bool) -> None:
    """At its joint, as before, the link before touches first: Spot's arm without its gripper had no plan."""
    hand = urdfs.link("flange", 0.5, (0.05, 0.05, 0.2), (0.0, 0.0, 0.1)).replace("collision>", "hidden>")
    own = urdfs.link("flange", 0.2, (0.07, 0.07, 0.03), (0.0, 0.0, -0.015))
    frame = _fixed("flange", "tool0", 'xyz="0 0 0"') if tool else ""
    striker, axis = _striker(tmp_path, _flange(frame).replace(own, hand))
    assert striker.point == pytest.approx([0.0, 0.0, 0.1]) and axis == pytest.approx([0.0, 0.0, 1.0])


def test_of_a_tool_at_the_joint_itself_a_long_hand_strikes(tmp_path: Path) -> None:
    """Where it ends, though the arm comes from another side."""
    hand = urdfs.link("hand", 0.3, (0.2, 0.05, 0.05), (0.1, 0.0, 0.0))
    held = _fixed("flange", "hand", 'xyz="0 0 0"').replace('<link name="hand"/>', hand)
    striker, axis = _striker(tmp_path, _flange(held + _fixed("flange", "tool0", 'xyz="0 0 0"')))
    assert striker.frame == "tool0" and striker.point == pytest.approx([0.2, 0.0, 0.0], abs=1e-6)
    assert axis == pytest.approx([1.0, 0.0, 0.0])


@pytest.mark.slow
def test_where_no_plan_is_found_motions_may_last_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where the guess from the joints' speeds is too short."""
    short = {"swing": (0.05, 0.2), "follow": (0.05, 0.2)}
    monkeypatch.setattr("impactopt.files.draft.drafting.durations", lambda *given: short)
    problem = _problem(tmp_path, urdfs.arm().replace('velocity="4.0"', 'velocity="3.9"'), planned=True)
    assert problem.swing.duration[1] == 0.4
    assert solve(problem).status.usable


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "strikes"), [("punch", MAX_STRIKES), ("nail", 2)])
def test_a_flange_that_the_wrist_hides_gets_a_peg(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, motion: str, strikes: int
) -> None:
    """As of some makers' arms: with nothing mounted the link before would touch the target first."""
    monkeypatch.setattr(strong, "MAX_STRIKES", strikes)
    hidden, shown = urdfs.arm(), '<origin xyz="0.0 0.0 0.15"/><geometry><box size="0.08 0.08 0.3"/>'
    at = hidden.index(shown, hidden.index('<link name="elbow_link"'))
    around = '<origin xyz="0.0 0.0 0.235"/><geometry><box size="0.2 0.2 0.47"/>'
    text = hidden[:at] + around + hidden[at + len(shown) :]
    stiff = text.replace('lower="-2.0" upper="2.0"', 'lower="-0.6" upper="0.6"')
    assert stiff != text
    draft = _drafted(tmp_path, stiff, motion=motion)
    assert "a peg of 5 cm" in "".join(draft.said)
    (peg,) = read_toml(draft.text)["robot"]["tools"]
    (tmp_path / "robot.toml").write_text(draft.text)
    problem = load_problem(tmp_path / "robot.toml")
    assert problem.striker == "peg" and peg["head_m"][2] == pytest.approx(peg["center_m"][2] + 0.025)
    assert optimize_strike(problem).status.usable
    assert "peg" not in _drafted(tmp_path, urdfs.arm(), motion=motion).text


def test_links_without_mass_are_told(tmp_path: Path) -> None:
    text = re.sub(r"<inertial>.*?</inertial>", "", urdfs.arm())
    with pytest.raises(InputError, match=r"its links have no mass.*give each an <inertial>"):
        _drafted(tmp_path, text)


@pytest.mark.slow
def test_a_shape_larger_than_the_robot_is_told_and_no_body(tmp_path: Path) -> None:
    """As of a mesh in millimetres; where the robot is plausible nothing is left out."""
    text = urdfs.arm().replace('<box size="0.08 0.08 0.3"/>', '<box size="80 80 300"/>')
    problem = _problem(tmp_path, text)
    told = doubts(problem.robot)
    assert len(told) == 2 and all("3.2e+02 m large" in line for line in told)
    bodies = bodies_of(problem.robot)
    assert {piece.link for piece in bodies.pieces if piece.assumed} == {"shoulder", "elbow"}
    assert max(np.ptp(piece.vertices, axis=0).max() for piece in bodies.pieces) < 0.5
    assert max(np.ptp(v.solid.vertices, axis=0).max() for v in visuals_of(problem.robot)) < 0.5
    assert not any(piece.assumed for piece in bodies_of(_problem(tmp_path, urdfs.arm()).robot).pieces)


@pytest.mark.slow
def test_a_shape_far_from_its_link_is_told_and_does_not_strike(tmp_path: Path) -> None:
    text = urdfs.arm().replace(
        '<collision><origin xyz="0.0 0.0 0.05"/><geometry><box size="0.08 0.08 0.1"/>',
        '<collision><origin xyz="0.0 0.6 0.05"/><geometry><box size="0.08 0.08 0.1"/>',
    )
    assert text != urdfs.arm()
    problem = _problem(tmp_path, text)
    (told,) = [line for line in doubts(problem.robot) if "wrist_link" in line]
    assert "a shape of link 'wrist_link', 0.15 m large, is 0." in told and "correct its <origin>" in told
    point = problem.robot.striker(problem.striker).point
    assert abs(point[1]) < 0.05 and point[2] > 0.05


@pytest.mark.slow
def test_what_the_file_lacks_is_guessed_and_said_to_be(tmp_path: Path) -> None:
    draft = _drafted(tmp_path, urdfs.arm(effort=0.0, velocity=0.0))
    keys = read_toml(draft.text)["robot"]
    joints = {"turn", "shoulder", "elbow", "wrist"}
    for key in ("armature_kg_m2", "torque_limit_N_m", "velocity_limit_rad_s"):
        assert set(keys[key]) == joints and min(keys[key].values()) > 0
        above = draft.text.partition(f"[robot.{key}]")[0].splitlines()[-1]
        assert "a GUESS" in above
    # the shoulder can hold the arm stretched out: 6 kg, 0.39 m away on average, and more
    weight = 9.81 * (2 * 0.15 + 2 * (0.3 + 0.15) + 2.06 * 0.65)
    assert keys["torque_limit_N_m"]["shoulder"] > weight
    assert sum("guessed" in line for line in draft.said) == 4  # and the gains


@pytest.mark.slow
def test_motors_that_cannot_hold_the_arm_are_told(tmp_path: Path) -> None:
    """As of files that give each joint the same placeholder."""
    draft = _drafted(tmp_path, urdfs.arm(effort=9.0), planned=True)
    (told,) = [line for line in draft.said if "no whole motion" in line]
    (why,) = [line for line in draft.said if "do not hold the robot's own weight" in line]
    assert draft.said.index(why) == draft.said.index(told) + 1


def test_the_torque_of_an_excavator_is_its_own(tmp_path: Path) -> None:
    """A boom of 4 t and 6 m needs 1.2e5 N m against gravity: its drive of 4e5 N m is no missing limit."""
    boom = urdfs.link("boom", 4000.0, (6.0, 0.5, 0.5), (3.0, 0.0, 0.0))
    lift = urdfs.joint(
        "lift", "base", "boom", "0 -1 0", (0.0, 0.0, 2.0), (-0.5, 1.0), effort=4e5, velocity=0.5
    )
    base = urdfs.link("base", 1e4, (4.0, 3.0, 2.0), (0.0, 0.0, 1.0))
    (tmp_path / "robot.urdf").write_text(urdfs.robot("excavator", base, boom, lift))
    found = guess_drives(read_urdf(tmp_path / "robot.urdf", floating=False).model, {})
    assert found.torque == {} and found.said == []
    assert found.armature == {"lift": 400.0}


def test_the_torque_of_an_excavator_in_an_arm_is_not_believed(tmp_path: Path) -> None:
    """Some files have 20 or 50 kN m in each joint of a humanoid: a rotor for that outweighs the robot."""
    found = _robot(tmp_path, urdfs.arm(effort=5e4)).drives
    assert found.torque == _robot(tmp_path, urdfs.arm(effort=0.0)).drives.torque != {}
    assert "torque limit of shoulder, 50000 N m: hard to believe, and guessed" in found.said


@pytest.mark.slow
def test_a_draft_does_not_say_that_a_file_lacks_limits_which_it_does_not_believe(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(urdfs.arm(effort=5e4))
    draft = draft_problem(tmp_path / "robot.urdf", folder=tmp_path, planned=False)
    assert "guessed, as the URDF has no plausible ones: torque limits of 4 joints" in draft.said
    assert "the file has no plausible one\n[robot.torque_limit_N_m]" in draft.text


def test_a_guessed_rotor_bears_the_servo_of_the_file(tmp_path: Path) -> None:
    """An MJCF with stiff servos, and neither torque limits nor armature, as of an iiwa 14, was refused."""
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text("""
        <mujoco><default><geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></default><worldbody>
        <body name="base"><geom/><body name="upper" pos="0 0 .1">
        <joint name="shoulder" axis="0 1 0" range="-100 100"/><geom/>
        <body name="lower" pos="0 0 .05"><joint name="elbow" axis="0 1 0" range="-140 140"/><geom/>
        </body></body></body></worldbody><actuator><position joint="shoulder" kp="2000" kv="200"/>
        <position joint="elbow" kp="2000" kv="200"/></actuator></mujoco>
    """)
    robot = draft_robot(path, mjcf=True).robot
    assert (robot.kd == 200.0).all()
    assert robot.armature == pytest.approx(2 * 200.0 / 3e4, rel=0.05)


def test_a_limit_that_no_motor_has_is_none(tmp_path: Path) -> None:
    """Exporters write 1e9 where a model has no limit: as a torque, it would have a rotor of 1e6 kg m2."""
    drafted = _robot(tmp_path, urdfs.arm(effort=1e9, velocity=1e9))
    plain = _robot(tmp_path, urdfs.arm(effort=0.0, velocity=0.0))
    for key in ("armature", "torque_limit", "velocity_limit"):
        np.testing.assert_array_equal(getattr(drafted.robot, key), getattr(plain.robot, key))


@pytest.mark.slow
def test_joints_of_a_file_without_ranges_get_some(tmp_path: Path) -> None:
    """As of onshape-to-robot's; beside joints with a range, one without is that of a loop, and fixed."""
    arm = urdfs.arm()
    text, count = re.subn(r'<limit lower="-\S+" upper="\S+" ', "<limit ", arm)
    assert count == 4
    draft = _drafted(tmp_path, text)
    problem = _problem(tmp_path, text)
    assert "guessed, as the URDF has no plausible ones: position limits of 4 joints" in draft.said
    assert problem.robot.n == 4 and (problem.robot.upper > 3.1).all() and (problem.robot.lower < -3.1).all()
    for wrist in ("", 'lower="0" upper="0"'):
        fixed = _robot(tmp_path, arm.replace('lower="-2.0" upper="2.0"', wrist))
        assert fixed.locked["wrist"] == "no range"


def test_a_rotor_without_its_gear_is_not_believed(tmp_path: Path) -> None:
    """Some files give the rotor's own inertia, without the square of the gear's ratio."""
    (tmp_path / "robot.urdf").write_text(urdfs.arm(effort=60.0))
    model = read_urdf(tmp_path / "robot.urdf", floating=False).model
    model.armature = np.array([5e-5, 7e-5, 0.0, 0.1, 1e-5, 0.0])
    drives = guess_drives(model, {})
    assert drives.armature.keys() == {"turn", "elbow", "slide_0", "slide_1"}
    assert drives.armature["turn"] == drives.armature["elbow"] > 0.01
    assert drives.said == [
        "armature of turn, 5e-05 kg m2: hard to believe, and guessed",
        "armature of slide_0, 1e-05 kg: hard to believe, and guessed",
    ]


def test_limits_that_are_hard_to_believe_are_told_in_the_joints_units(tmp_path: Path) -> None:
    rail = urdfs.joint("rail", "a", "b", "1 0 0", (0, 0, 0), (0, 1), kind="prismatic", effort=2e4)
    turn = urdfs.joint("turn", "base", "a", "0 0 1", (0, 0, 0.5), (-1, 1), effort=600.0)
    links = [urdfs.link(name, 2.0, (0.3, 0.1, 0.1), (0.15, 0, 0)) for name in ("base", "a", "b")]
    text = urdfs.robot("crane", *links, turn, rail).replace('velocity="6.0"', 'velocity="100"')
    assert _robot(tmp_path, text).drives.said == [
        "torque limit of turn, 600 N m: hard to believe",
        "velocity limit of turn, 100 rad/s: hard to believe",
        "torque limit of rail, 20000 N: hard to believe",
        "velocity limit of rail, 100 m/s: hard to believe",
    ]
    robot = draft_robot(tmp_path / "robot.urdf").made(armature={"turn": 1.0, "rail": 1e-3})
    (told,) = (text for text in doubts(robot) if text.startswith("armature of rail"))
    assert "0.001 kg is hard to believe of a drive of 2e+04 N, too small; 0.02 kg is the least" in told


@pytest.mark.parametrize("stages", [1, 2], ids=["one stage", "a second one that follows"])
def test_the_guessed_torque_holds_an_extended_telescope(tmp_path: Path, stages: int) -> None:
    """With the promised factor over gravity, horizontal and at its full length, and no more than that."""
    none = {"effort": 0.0, "velocity": 0.0}
    parts = [urdfs.link("base", 10.0, (0.2, 0.2, 0.4), (0, 0, 0.2))]
    parts += [urdfs.link("tube_0", 2.0, (0.3, 0.05, 0.05), (0.15, 0, 0))]
    parts += [urdfs.joint("shoulder", "base", "tube_0", "0 1 0", (0, 0, 0.5), (-2, 2), **none)]
    for k in range(stages):
        parts += [urdfs.link(f"tube_{k + 1}", 1.0, (0.3, 0.05, 0.05), (0.15, 0, 0))]
        slide = {"kind": "prismatic", **none}
        parts += [
            urdfs.joint(f"out_{k}", f"tube_{k}", f"tube_{k + 1}", "1 0 0", (0.3, 0, 0), (0, 3), **slide)
        ]
    law = 'joint="out_0" multiplier="0.5" offset="0.2"'
    robot = _robot(tmp_path, urdfs.following(urdfs.robot("telescope", *parts), "out_1", law)).robot
    assert robot.joint_names == ("shoulder", "out_0") and len(robot.couplings) == stages - 1
    out = np.array([0.0, 3.0])
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), out)
    assert robot.torque_limit[0] == pytest.approx(3 * abs(gravity[0]), rel=0.05)  # rounded to two digits


@pytest.mark.parametrize("effort", [0.05, 60.0])
def test_a_guessed_rotor_is_what_the_draft_says(tmp_path: Path, effort: float) -> None:
    """1 g m2 for each N m, also of motors of some grams."""
    drives = _robot(tmp_path, urdfs.arm(effort=effort)).drives
    assert drives.armature == dict.fromkeys(("turn", "shoulder", "elbow", "wrist"), 1e-3 * effort)


def test_an_inner_joint_of_six_degrees_of_freedom_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'turn'.*6 degrees of freedom.*split it"):
        _robot(tmp_path, urdfs.arm().replace('name="turn" type="revolute"', 'name="turn" type="floating"'))


def test_negative_limits_stand_for_none(tmp_path: Path) -> None:
    """As in SDF; Pinocchio refuses them."""
    robots = [_robot(tmp_path, urdfs.arm(effort=limit, velocity=limit)).robot for limit in (-1.0, 0.0)]
    for key in ("armature", "torque_limit", "velocity_limit"):
        np.testing.assert_array_equal(*(getattr(robot, key) for robot in robots))


def test_numbers_that_the_file_has_are_not_guessed(tmp_path: Path) -> None:
    keys = read_toml(_drafted(tmp_path, urdfs.arm()).text)["robot"]
    assert "torque_limit_N_m" not in keys and "velocity_limit_rad_s" not in keys


def test_bad_inertias_are_listed_and_their_repair_has_to_be_said(tmp_path: Path) -> None:
    draft = _drafted(tmp_path, urdfs.biped(moments=FLAT))
    (told,) = (line for line in draft.said if "1 inertia is not physical" in line)
    assert "'right_elbow'" in draft.text and ": correct it, or" in told
    file = tmp_path / "robot.toml"
    file.write_text(draft.text)
    with pytest.raises(InputError, match="'right_elbow'"):
        load_problem(file)
    file.write_text(draft.text.replace("# inertias =", "inertias ="))
    problem = load_problem(file)
    assert "right_elbow" in problem.describe()["inertias"][0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (urdfs.biped(legs=4), "2 legs of 4 joints .*left_hip_pitch.*two legs of 6 or more.* two of 5"),
        (urdfs.biped(pairs=2), "4 legs of 6 joints.*--bolted"),
    ],
    ids=["four joints", "four legs"],
)
def test_legs_that_no_plan_can_hold_are_told_first(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        _drafted(tmp_path, text)


def test_a_drawing_of_lines_has_no_soles(tmp_path: Path) -> None:
    x, y = urdfs.SOLE
    text = urdfs.biped().replace(f'<box size="{x} {y} 0.04"/>', '<sphere radius="0.02"/>')
    with pytest.raises(InputError, match=r"no flat face of 20 cm2"):
        _drafted(tmp_path, text)


@pytest.mark.slow
@pytest.mark.parametrize(("effort", "locked"), [(20.0, True), (2000.0, False)])
def test_a_lift_that_cannot_carry_the_arm_is_locked(tmp_path: Path, effort: float, locked: bool) -> None:
    """Makers' files have such limits where nobody looked."""
    text = urdfs.arm().replace('<parent link="base"/>', '<parent link="lift"/>', 1)
    lift = urdfs.link("lift", 4.0, (0.1, 0.1, 0.1), (0, 0, 0))
    rail = urdfs.joint(
        "rise", "base", "lift", "0 0 1", (0, 0, 0.2), (0, 0.4), kind="prismatic", effort=effort
    )
    draft = _drafted(tmp_path, text.replace("</robot>", f"{lift}{rail}</robot>"))
    assert ("too weak for what it carries (rise)" in "".join(draft.said)) == locked
    assert ("rise" in read_toml(draft.text)["robot"].get("locked_rad", {})) == locked


@pytest.mark.parametrize(("damping", "held"), [(1e3, False), (1e7, True)])
def test_a_joint_that_its_damping_holds_is_locked(tmp_path: Path, damping: float, held: bool) -> None:
    """As simulators have Gymnasium's Fetch stand still: plans have no friction in the equations of motion."""
    path = tmp_path / "robot.urdf"
    path.write_text(urdfs.arm().replace("</joint>", f'<dynamics damping="{damping}"/></joint>', 1))
    assert (draft_robot(path).locked.get("turn") == "held by its damping") == held


def test_joints_that_their_damping_holds_are_named_where_nothing_is_drafted(tmp_path: Path) -> None:
    """The message was to check the joints, or of a leg without the knee that was locked."""
    damping = '<dynamics damping="1e7"/></joint>'
    with pytest.raises(InputError, match=r"no joint is left to move; locked: .*turn \(held by its damping\)"):
        _drafted(tmp_path, urdfs.arm().replace("</joint>", damping))
    stiff = re.sub(r'(<joint name="left_knee".*?)</joint>', rf"\1{damping}", urdfs.biped())
    with pytest.raises(InputError, match="joints held by their damping, locked: left_knee; no posture"):
        _drafted(tmp_path, stiff)


def test_the_drives_of_a_mobile_base_are_locked(tmp_path: Path) -> None:
    """Fetch's arm was to strike 2.4 m beside it, where no swing of a second takes its base."""
    text = urdfs.arm().replace('<parent link="base"/>', '<parent link="mobile"/>', 1)
    links = [urdfs.link(name, 4.0, (0.1, 0.1, 0.1), (0, 0, 0)) for name in ("turning", "mobile")]
    far = (-999999.0, 999999.0)
    steer = urdfs.joint("steer", "base", "turning", "0 0 1", (0, 0, 0.2), far)
    roll = urdfs.joint("roll", "turning", "mobile", "1 0 0", (0, 0, 0), far, kind="prismatic")
    (tmp_path / "robot.urdf").write_text(text.replace("</robot>", f"{''.join(links)}{steer}{roll}</robot>"))
    locked = draft_robot(tmp_path / "robot.urdf").locked
    assert {joint for joint, why in locked.items() if why == "drives a base"} == {"steer", "roll"}
    plane = [
        urdfs.joint("x", "base", "sliding", "1 0 0", (0, 0, 0.2), (-10.0, 10.0), kind="prismatic"),
        urdfs.joint("y", "sliding", "turning", "0 1 0", (0, 0, 0), far, kind="prismatic"),
        urdfs.joint("yaw", "turning", "mobile", "0 0 1", (0, 0, 0), far),
    ]
    links.append(urdfs.link("sliding", 4.0, (0.1, 0.1, 0.1), (0, 0, 0)))
    (tmp_path / "robot.urdf").write_text(text.replace("</robot>", f"{''.join(links + plane)}</robot>"))
    locked = draft_robot(tmp_path / "robot.urdf").locked
    assert {joint for joint, why in locked.items() if why == "drives a base"} == {"x", "y", "yaw"}


@pytest.mark.slow
def test_an_mjcf_is_drafted_too(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text("""
        <mujoco model="tiny"><worldbody><body name="base"><geom type="box" size=".1 .1 .2" pos="0 0 .2"/>
        <body name="upper" pos="0 0 .5"><joint name="shoulder" axis="0 1 0" range="-100 100"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 .3"/><body name="lower" pos="0 0 .3">
        <joint name="elbow" axis="0 1 0" range="-140 140"/>
        <geom type="capsule" size=".03" fromto="0 0 0 0 0 .3"/>
        <geom type="sphere" size=".08" pos="0 0 .4" contype="0" conaffinity="0" mass="0"/>
        </body></body></body></worldbody>
        <actuator><motor joint="elbow" ctrlrange="-30 30"/></actuator></mujoco>
    """)
    draft = draft_problem(path, folder=tmp_path, mjcf=True)
    assert "no actuator moves 'shoulder'" in "".join(draft.said)
    assert set(read_toml(draft.text)["robot"]["torque_limit_N_m"]) == {"shoulder"}
    (striker,) = read_toml(draft.text)["robot"]["strikers"]
    assert striker["point_m"] == pytest.approx([0.0, 0.0, 0.48], abs=1e-3)
    (tmp_path / "arm.toml").write_text(draft.text)
    assert load_problem(tmp_path / "arm.toml").robot.torque_limit[1] == 30.0


def test_an_mjcf_with_weightless_fingers_is_bolted(tmp_path: Path) -> None:
    """It was read as one that floats, which refused the gravcomp of its fingers before they were locked."""
    pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text("""
        <mujoco><default><geom type="capsule" size=".03" fromto="0 0 0 0 0 .3"/></default><worldbody>
        <body name="base"><geom/><body name="upper" pos="0 0 .3">
        <joint name="shoulder" axis="0 1 0" range="-100 100"/><geom/>
        <body name="lower" pos="0 0 .3"><joint name="elbow" axis="0 1 0" range="-140 140"/><geom/>
        <body name="finger" pos="0 0 .3" gravcomp="1"><geom size=".01" fromto="0 0 0 0 0 .05"/>
        <joint name="claw" type="slide" axis="0 1 0" range="0 .05"/></body></body></body></body></worldbody>
        <actuator><motor joint="shoulder" ctrlrange="-90 90"/><motor joint="elbow" ctrlrange="-30 30"/>
        </actuator></mujoco>
    """)
    drafted = draft_robot(path, mjcf=True)
    assert not drafted.robot.floating and set(drafted.locked) == {"claw"}


def test_legs_with_a_weightless_finger_are_not_bolted_silently(tmp_path: Path) -> None:
    """The equations of motion of a robot that floats have no gravity of a finger's own."""
    mujoco = pytest.importorskip("mujoco")
    compiler = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'
    read = mujoco.MjModel.from_xml_string(re.sub(r"(<robot[^>]*>)", rf"\1{compiler}", urdfs.biped(), count=1))
    path = tmp_path / "biped.xml"
    mujoco.mj_saveLastXML(str(path), read)
    finger = """<body name="finger" pos="0 0 -0.25" gravcomp="1">
        <joint name="claw" type="slide" range="0 .03"/>
        <inertial pos="0 0 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/></body>"""
    elbow = r'(<body name="right_elbow_link"[^>]*>)'
    path.write_text(re.sub(elbow, rf"\1{finger}", path.read_text(), count=1))
    with pytest.raises(InputError, match=r"gravcomp of 'finger' .* stands on legs; give all of them"):
        draft_robot(path, mjcf=True)


@pytest.mark.slow
def test_a_joint_may_have_a_links_name(tmp_path: Path) -> None:
    same = urdfs.arm().replace('joint name="elbow"', 'joint name="elbow_link"')
    same = same.replace('joint name="slide_0"', 'joint name="claw_0"')
    plate = urdfs.joint("plate", "wrist_link", "plate", "0 0 1", (0, 0, 0), (0, 0), kind="fixed")
    same = same.replace("</robot>", f'<link name="plate"/>{plate}</robot>')
    problem = _problem(tmp_path, same)
    other = _problem(tmp_path, urdfs.arm())
    assert problem.robot.joint_names == ("turn", "shoulder", "elbow_link", "wrist")
    assert problem.start_posture == pytest.approx(other.start_posture)
    model = problem.robot.model
    assert model.frames[model.getFrameId("elbow_link")].type == pin.FrameType.BODY
    tool = problem.robot.with_tool(Tool.hammer(frame="elbow_link"))  # a name of a file's is the link's
    assert tool.model.inertias[3].mass > model.inertias[3].mass


@pytest.mark.parametrize(
    "base",
    ["", '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'],
    ids=["none", "zero"],
)
def test_the_root_of_an_arm_needs_no_mass(tmp_path: Path, base: str) -> None:
    text = re.sub(r'(<link name="base">)<inertial>.*?</inertial>', rf"\1{base}", urdfs.arm(), count=1)
    assert text != urdfs.arm()
    light, heavy = _robot(tmp_path, text).robot, _robot(tmp_path, urdfs.arm()).robot
    assert not light.floating
    q = np.linspace(0.3, 0.9, heavy.model.nq)
    one, other = (pin.crba(r.model, r.model.createData(), q) for r in (light, heavy))
    assert np.allclose(one, other, rtol=0, atol=1e-12)


def test_a_walker_with_a_floating_joint_of_its_own_is_refused_for_that(tmp_path: Path) -> None:
    free = '<joint name="free" type="floating"><parent link="world"/><child link="trunk"/></joint>'
    text = urdfs.biped().replace("</robot>", f'<link name="world"/>{free}</robot>')
    with pytest.raises(InputError, match=r"'free' is floating, and .*; remove it and its parent link$"):
        _robot(tmp_path, text)


def test_the_root_of_a_walker_needs_one(tmp_path: Path) -> None:
    text = re.sub(r'(<link name="trunk">)<inertial>.*?</inertial>', r"\1", urdfs.biped(), count=1)
    with pytest.raises(InputError, match=r"root link has no mass.*stands on legs.*--bolted"):
        _drafted(tmp_path, text)
    assert not draft_robot(tmp_path / "robot.urdf", bolted=True).robot.floating
    with pytest.raises(InputError, match=r"the root link 'trunk' .*mass 0 kg.*floating = false"):
        Robot.from_urdf(tmp_path / "robot.urdf")


def test_a_walker_in_a_plane_is_refused_for_the_joints_of_its_root(tmp_path: Path) -> None:
    xml = _walker(tmp_path)
    planar = '<joint name="x" type="slide" axis="1 0 0"/><joint name="pitch" axis="0 1 0"/>'
    xml.write_text(re.sub(r'(<body name="trunk"[^>]*>)', rf"\1{planar}", xml.read_text()))
    with pytest.raises(InputError, match=r"joints x, pitch move its root, .*; replace .*<freejoint/>"):
        draft_problem(xml, folder=tmp_path, mjcf=True)


@pytest.mark.slow
def test_a_follower_on_an_arm_follows(tmp_path: Path) -> None:
    text = urdfs.following(urdfs.arm(effort=0.0), "elbow", 'joint="shoulder" multiplier="-0.5" offset="0.1"')
    draft = _drafted(tmp_path, text)
    robot = read_toml(draft.text)["robot"]
    assert "elbow" not in {*robot["locked_rad"], *robot["postures_rad"]["ready"], *robot["torque_limit_N_m"]}
    made = draft_robot(tmp_path / "robot.urdf").robot
    assert made.joint_names == ("turn", "shoulder", "wrist") and made.couplings["elbow"].leader == "shoulder"
    # its motor lifts both, stretched out level
    free = guess_drives(read_urdf(tmp_path / "robot.urdf", floating=False).model, {}).torque
    assert robot["torque_limit_N_m"]["shoulder"] > free["shoulder"]


def test_followers_of_grippers_are_locked_with_their_leaders(tmp_path: Path) -> None:
    text = urdfs.following(urdfs.arm(), "slide_1", 'joint="slide_0" multiplier="1"')
    assert {"slide_0", "slide_1"} <= _robot(tmp_path, text).locked.keys()


def test_hips_that_share_a_motor_are_locked_straight(tmp_path: Path) -> None:
    law = 'joint="left_hip_yaw" multiplier="-1" offset="0"'
    problem = _problem(tmp_path, urdfs.following(urdfs.biped(), "right_hip_yaw", law))
    locked = read_toml((tmp_path / "robot.toml").read_text())["robot"]["locked_rad"]
    assert locked["left_hip_yaw"] == locked["right_hip_yaw"] == 0.0
    assert [sole.hinge is not None for sole in problem.robot.soles] == [True, True]  # legs of five joints


@pytest.mark.slow
def test_a_follower_that_cannot_follow_is_locked_where_its_leader_is_bent(tmp_path: Path) -> None:
    text = urdfs.following(urdfs.arm(), "shoulder", 'joint="elbow" multiplier="-0.5" offset="0.1"')
    text = text.replace('name="shoulder" type="revolute"', 'name="shoulder" type="continuous"')
    draft = _drafted(tmp_path, text)
    # a quarter of the elbow's range, -2.4 to 2.4 rad
    assert read_toml(draft.text)["robot"]["locked_rad"]["shoulder"] == pytest.approx(0.1 + 0.5 * 1.2)
    assert any("'shoulder' follows 'elbow' by <mimic>; 'shoulder' is locked" in line for line in draft.said)
    with pytest.raises(InputError, match=r"'shoulder' cannot follow 'elbow'.*is continuous.*lock it"):
        Robot.from_urdf(tmp_path / "robot.urdf", floating=False)


def test_a_leg_that_another_one_leads_is_locked_there(tmp_path: Path) -> None:
    text = urdfs.following(urdfs.biped(legs=7), "right_hip_tilt", 'joint="left_hip_tilt"')
    assert "right_hip_tilt" in _robot(tmp_path, text).locked


def test_followers_of_their_own_leg_follow(tmp_path: Path) -> None:
    text = urdfs.biped(legs=7)
    for side in ("left", "right"):
        text = urdfs.following(text, f"{side}_hip_pitch", f'joint="{side}_hip_tilt" multiplier="2.5"')
    draft = _drafted(tmp_path, text)
    (tmp_path / "robot.toml").write_text(draft.text)
    problem = load_problem(tmp_path / "robot.toml")  # whose start has level soles
    assert problem.robot.couplings.keys() == {"left_hip_pitch", "right_hip_pitch"}
    assert all(len(leg.joints) == 6 and not len(leg.before) for leg in problem.coordinates.legs)


@pytest.mark.slow
def test_meshes_that_are_no_bodies_are_told(tmp_path: Path) -> None:
    lost = (
        ('"0.08 0.08 0.3"/>', '<mesh filename="cut.stl"/>'),
        ('"0.08 0.08 0.1"/>', '<mesh filename="gone.stl"/>'),
    )
    text = urdfs.arm()
    for size, mesh in lost:
        text = text.replace(f"<box size={size}", mesh)
    (tmp_path / "cut.stl").write_bytes(b"version https://git-lfs.github.com/spec/v1")
    draft = _drafted(tmp_path, text)
    (tmp_path / "robot.toml").write_text(draft.text)
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "robot.toml")]).output
    for told in (" ".join(checked.split()), " ".join(draft.said)):
        assert "2 meshes are lost, and boxes of inertia stand for links without any: cut.stl: cannot" in told
        assert "git lfs pull" in told and "gone.stl: not found; put them into a folder above" in told


def test_crossed_limits_are_a_mistake(tmp_path: Path) -> None:
    text = re.sub('lower="-2.4" upper="2.4"', 'lower="2.4" upper="-2.4"', urdfs.arm())
    with pytest.raises(InputError, match=r"'elbow' .*lower 2.4, upper -2.4.*URDF's <limit>"):
        _drafted(tmp_path, text)


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["0 1 0", "0.3 1 0.2"])
def test_one_joint_strikes_along_its_circle(tmp_path: Path, axis: str) -> None:
    bar = urdfs.link("bar", 2.0, (0.05, 0.05, 0.5), (0, 0, 0.25))
    turn = urdfs.joint("turn", "base", "bar", axis, (0, 0, 1), (-2, 2))
    problem = _problem(
        tmp_path, urdfs.robot("one", urdfs.link("base", 1.0, (0.1, 0.1, 0.1), (0, 0, 0)), bar, turn)
    )
    about = np.array([float(x) for x in axis.split()])
    arm = problem.point - [0.0, 0.0, 1.0]
    end = problem.robot.striker(problem.striker).point
    assert arm @ about == pytest.approx(end @ about, abs=1e-8)
    assert np.linalg.norm(arm) == pytest.approx(np.linalg.norm(end), abs=1e-8)
    assert [problem.normal @ about, problem.normal @ arm] == pytest.approx([0.0, 0.0], abs=1e-8)
    assert solve(problem).status.usable


@pytest.mark.slow
def test_a_ram_strikes_along_its_joint(tmp_path: Path) -> None:
    """A link without shapes and offsets, which reaches nothing but its own line."""
    ram = urdfs.link("ram", 2.0, (0.1, 0.1, 0.1), (0, 0, 0))
    ram = re.sub("<collision>.*</collision>", "", ram)
    at, options = (0, 0, 1.0004), {"kind": "prismatic", "effort": 500.0}
    slide = urdfs.joint("slide", "base", "ram", "1 0 0", at, (-1, 1), **options)
    base = urdfs.link("base", 1.0, (0.1, 0.1, 0.1), (0, 0, 0))
    problem = _problem(tmp_path, urdfs.robot("one", base, ram, slide))
    assert problem.point[1:] == pytest.approx([0.0, 1.0004], abs=1e-9)
    assert problem.normal == pytest.approx([1.0, 0.0, 0.0])
    assert solve(problem).status.usable


def _walker(folder: Path) -> Path:
    """An MJCF of the biped, without a free joint."""
    mujoco = pytest.importorskip("mujoco")
    path, xml = folder / "robot.urdf", folder / "robot.xml"
    kept = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'  # its root is bolted, and a body still
    path.write_text(urdfs.biped().replace("</robot>", kept))
    mujoco.mj_saveLastXML(str(xml), mujoco.MjModel.from_xml_path(str(path)))
    return xml


@pytest.mark.slow
def test_a_walker_with_weak_arms_starts_as_they_can_hold_them(tmp_path: Path) -> None:
    """Bent ahead they needed more than their torque limits."""
    weak = r'(<joint name="(?:left|right)_(?:shoulder|elbow)\w*".*?effort=")[\d.]+'
    problem = _problem(tmp_path, re.sub(weak, r"\g<1>1.0", urdfs.biped()))
    data, q = problem.robot.model.createData(), problem.start_posture
    load = np.abs(problem.robot.generalized_gravity(data, q)[6:]) / problem.robot.torque_limit
    arms = [problem.robot.joint_index(f"{side}_shoulder_pitch") for side in ("left", "right")]
    assert load[arms].max() < TorqueLimit().fraction


def test_knees_that_an_equality_fixes_are_named_where_no_posture_is_found(tmp_path: Path) -> None:
    xml, law = _walker(tmp_path), '<joint joint1="{}_knee" polycoef="0.4 0 0 0 0"/>'
    laws = "".join(law.format(side) for side in ("left", "right"))
    xml.write_text(xml.read_text().replace("</mujoco>", f"<equality>{laws}</equality></mujoco>"))
    with pytest.raises(InputError, match=r"fixed in the file, locked: left_knee, right_knee; no posture"):
        draft_problem(xml, folder=tmp_path, mjcf=True)


@pytest.mark.slow
def test_a_walker_whose_roots_frame_lies_is_drafted_upright(tmp_path: Path) -> None:
    xml = _walker(tmp_path)
    (tmp_path / "upright.toml").write_text(draft_problem(xml, folder=tmp_path, mjcf=True).text)
    turn, tree = pin.rpy.rpyToMatrix(np.pi / 2, 0.0, 0.0), ElementTree.parse(xml)
    (root,) = tree.findall("worldbody/body")
    for part in root:  # all on it is turned back
        place = [float(x) for x in part.get("pos", "0 0 0").split()]
        w, x, y, z = (float(x) for x in part.get("quat", "1 0 0 0").split())
        part.set("pos", _words(turn.T @ place))
        part.set("quat", _words(_wxyz(turn.T @ pin.Quaternion(w, x, y, z).matrix())))
    root.set("quat", _words(_wxyz(turn)))
    tree.write(xml)
    (tmp_path / "turned.toml").write_text(draft_problem(xml, folder=tmp_path, mjcf=True).text)
    upright, turned = (load_problem(tmp_path / f"{name}.toml") for name in ("upright", "turned"))
    own, same = upright.start_posture, turned.start_posture
    assert turned.robot.joint_positions(same) == pytest.approx(upright.robot.joint_positions(own), abs=1e-4)
    assert pin.Quaternion(*same[[6, 3, 4, 5]]).matrix() == pytest.approx(turn)
    assert turned.point == pytest.approx(upright.point, abs=2e-3)
    assert turned.normal == pytest.approx(upright.normal)


def _wxyz(turn: Any) -> Any:
    return pin.Quaternion(turn).coeffs()[[3, 0, 1, 2]]


def _words(numbers: Any) -> str:
    return " ".join(f"{x:.15g}" for x in numbers)


def test_an_mjcf_of_a_walker_without_a_free_joint_stands(tmp_path: Path) -> None:
    xml = _walker(tmp_path)
    draft = draft_problem(xml, folder=tmp_path, mjcf=True)
    robot = read_toml(draft.text)["robot"]
    assert robot["floating"] is True and len(robot["soles"]) == 2
    assert any("no free joint" in line for line in draft.said)
    assert not draft_robot(xml, mjcf=True, bolted=True).robot.floating


@pytest.mark.parametrize("lies", ["0.7071068 0.7071068 0 0", "0 1 0 0"], ids=["on its back", "head down"])
def test_a_floating_mjcf_that_does_not_stand_is_bolted_and_told(tmp_path: Path, lies: str) -> None:
    """A walker that lies with all joints at zero."""
    xml = _walker(tmp_path)
    assert not draft_robot(xml, mjcf=True).fixed
    xml.write_text(re.sub(r'(<body name="trunk"[^>]*)>', rf'\1 quat="{lies}"><freejoint/>', xml.read_text()))
    draft = draft_robot(xml, mjcf=True)
    assert draft.fixed and not draft.robot.floating
    bolted = draft_robot(xml, mjcf=True, bolted=True)
    assert not bolted.fixed and not bolted.turn
    _, quat, _ = draft.turn.split("'")
    xml.write_text(xml.read_text().replace(lies, quat))
    assert len(draft_robot(xml, mjcf=True).legs) == 2
    trunk = pin.Quaternion(*map(float, quat.split())).matrix()
    assert trunk[2, 2] == pytest.approx(1.0), "upright"


@pytest.mark.slow
def test_a_draft_keeps_the_limits_that_a_robot_s_manufacturer_publishes(tmp_path: Path) -> None:
    draft = draft_problem(find_description("panda"), folder=tmp_path, planned=False)
    assert "(Franka Control Interface documentation" in draft.text
    (tmp_path / "panda.toml").write_text(draft.text)
    plan = solve(load_problem(tmp_path / "panda.toml"))
    assert plan.status.usable
    limit = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])
    away = plan.trajectory.phase != 1  # in contact the reference coasts
    used = np.abs(plan.trajectory.a[away]).max(axis=0) / limit
    assert 0.99 < used.max() < 1.001


@pytest.mark.slow
def test_a_drafted_nail_is_driven_as_far_as_from_another_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a drawn posture, with half of the estimate of that which the draft has found, it was a quarter."""
    monkeypatch.setattr(strong, "MAX_STRIKES", MAX_STRIKES)
    draft = draft_problem(find_description("panda"), folder=tmp_path, motion="nail", planned=False)
    (tmp_path / "nail.toml").write_text(draft.text)
    problem = load_problem(tmp_path / "nail.toml")
    one, two = (solve(problem, starts=starts).objectives["target energy"] for starts in (1, 2))
    assert one > 0.95 * two


def test_robots_of_example_robot_data_go_by_name() -> None:
    pytest.importorskip("pinocchio")
    try:
        assert find_description("panda").name == "panda.urdf"
    except InputError as error:
        pytest.skip(str(error))
    assert find_description("ur5").name == "ur5_robot.urdf"
    with pytest.raises(InputError, match="did you mean 'panda'"):
        find_description("pnada")
    with pytest.raises(InputError, match=r"several robots 'alex'.*alex_nub_hands"):
        find_description("alex")
    with pytest.raises(InputError, match=r"did you mean 'g1_29dof_rev_1_0'"):  # a dot makes it no file
        find_description("g1_29dof_rev_1.0")
    with pytest.raises(InputError, match=r"there is no file gone.urdf$"):
        find_description("gone.urdf")


@pytest.mark.slow
def test_the_command_writes_a_file_once(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(urdfs.arm())
    out = tmp_path / "my arm.toml"
    words = ["new", "--urdf", str(tmp_path / "arm.urdf"), "--out", str(out)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "guessed" in done.output
    (commands,) = [line for line in done.output.splitlines() if line.startswith("next: ")]
    first, then = commands.removeprefix("next: ").split("; then ")
    assert shlex.split(first) == ["impactopt", "check", str(out)]
    assert shlex.split(then) == ["impactopt", "solve", str(out)]
    assert read_toml(out.read_text())["robot"]["urdf"] == "arm.urdf"
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2 and "already" in again.output
    assert CliRunner().invoke(app, ["new", "punch", "--urdf", "x"]).exit_code == 2


@pytest.mark.slow
def test_a_robots_file_in_place_of_a_name_is_drafted_for(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(urdfs.arm())
    done = CliRunner().invoke(app, ["new", str(tmp_path / "arm.urdf"), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["data"]["robot"]["urdf"].endswith("arm.urdf")
    gone = CliRunner().invoke(app, ["new", "gone.xml"])
    assert gone.exit_code == 2 and "MJCF gone.xml: no such file" in gone.output


def test_angles_are_those_of_the_posture(tmp_path: Path) -> None:
    problem = _problem(tmp_path, urdfs.arm())
    q = problem.robot.joint_positions(problem.start_posture)
    assert np.all(q > problem.robot.lower + 0.05) and np.all(q < problem.robot.upper - 0.05)
