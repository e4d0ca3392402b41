"""Problem files: what they say reaches the problem; what is wrong in them is named, with the fix."""

from __future__ import annotations

import dataclasses
from inspect import cleandoc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problem_texts import ARM, write

import impactopt.files.problem_file.sections as sections
import impactopt.files.sections.robot as robot_sections
from impactopt import (
    Board,
    FixedBase,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    ImpactProblem,
    InputError,
    KelvinVoigt,
    Nail,
    Obstacle,
    OneSole,
    Phase,
    RigidWall,
    Scenario,
    SpringDamper,
    TargetBody,
    Tool,
    load_problem,
    talos,
)
from impactopt.contact.laws import LAWS
from impactopt.contact.targets import TARGETS
from impactopt.files.problem_file import read_problem_file
from impactopt.files.sections.diagnostics import key_lines
from impactopt.files.sections.values import Section, attribute_docs
from impactopt.problem import objectives, terms
from impactopt.problem.problem import COLLISIONS
from impactopt.solvers.sqp import SQPOptions

PUNCH = Path(__file__).parents[2] / "problems" / "punch.toml"

GOOD = """\
[problem]
robot = "talos"
striker = "right_hand"
point_m = [0.6, -0.25, 1.1]
normal = [1.0, 0.0, 0.0]

[target]
mass_kg = 5.0

[contact]
stiffness_N_m = 1e4
damping_N_s_m = 300.0
"""


def message(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        load_problem(path)
    return str(caught.value)


@pytest.fixture
def no_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Building a robot fails the test."""

    def refuse(*args: Any, **options: Any) -> None:
        raise AssertionError("a robot was built")

    monkeypatch.setattr(robot_sections, "load_robot", refuse)


def test_the_demos_file_is_the_punch_it_says() -> None:
    problem = load_problem(PUNCH)
    assert (problem.robot.name, problem.striker, problem.start) == ("talos", "right_hand", "half_sitting")
    np.testing.assert_array_equal(problem.point, [0.6, -0.25, 1.1])
    np.testing.assert_array_equal(problem.normal, [1, 0, 0])
    assert problem.target == FreeMass(mass=5.0)
    assert problem.law == SpringDamper(stiffness=1e4, damping=300.0)
    assert read_problem_file(PUNCH).solver.name == "ipm"


def test_a_byte_order_mark_of_windows_is_no_mistake(tmp_path: Path) -> None:
    file = tmp_path / "windows.toml"
    file.write_text(PUNCH.read_text("utf-8").replace("\n", "\r\n"), "utf-8-sig", newline="")
    assert load_problem(file).hash == load_problem(PUNCH).hash


def test_the_commented_keys_of_the_demos_file_show_the_defaults(tmp_path: Path) -> None:
    """Whoever takes the # away gets the same problem, and can then change the number."""
    text = PUNCH.read_text(encoding="utf-8")
    hidden = [line for line in text.splitlines() if line.startswith("# ") and " = " in line]
    assert hidden
    shown = text
    for line in hidden:
        if "time_limit" not in line:
            shown = shown.replace(line, line.removeprefix("# "))
    a, b = load_problem(PUNCH), load_problem(write(tmp_path, shown))
    for field in dataclasses.fields(ImpactProblem):
        if field.name not in ("robot", "point", "normal"):
            assert getattr(a, field.name) == getattr(b, field.name), field.name


def test_what_a_docstring_says_of_options_is_read_with_and_without_its_margin() -> None:
    said = attribute_docs(SQPOptions)
    assert {*said} == {option.name for option in dataclasses.fields(SQPOptions)}
    bare = type(
        "Bare", SQPOptions.__bases__, {"__doc__": cleandoc(SQPOptions.__doc__ or "")}
    )  # as Python 3.13 keeps it
    assert attribute_docs(bare) == said


def test_all_that_a_file_says_reaches_the_problem(tmp_path: Path) -> None:
    more = """
[stance]
soles = "left"
[swing]
duration_s = [0.5, 0.9]
intervals = 9
grading = 2.0
[follow]
duration_s = 1.5
[collision]
duration_s = [0.004, 0.1]
stages = 3
restitution = [0.25, 0.75]
[[scenarios]]
name = "all of it"
mass = 1.5
stiffness = 2
damping = 0
torque = 0.9
cone_margin_m = 0.01
capture_margin_m = 0.03
[[scenarios]]
name = "nothing there"
missing = true
[objective]
smoothness = 1e-5
wrench_price = 2e-3
[terms.torque_limit]
fraction = 0.7
collision = 0.8
[terms.velocity_limit]
fraction = 0.6
[terms.position_limit]
margin_rad = 0.03
[terms.contact_wrench_cone]
friction = 0.5
margin_m = 0.01
collision_margin_m = 0.015
minimum_force_N = 20
[terms.balance]
capture_margin_m = 0.03
vertical_speed_m_s = 0.15
angular_momentum_N_m_s = 6
[terms.incidence]
speed_m_s = 0.1
[objectives.impulse]
weight = 2.0
[objectives.peak_force]
weight = -0.02
[objectives.target_energy]
weight = 0.5
[objectives.penetration]
[objectives.angular_momentum]
weight = 0.1
[objectives.effort]
[solver]
name = "ipm"
time_limit_s = 12
[solver.ipopt]
max_iter = 77
[solver.ipm]
max_iterations = 99
price = 50.0
"""
    named = GOOD.replace('"talos"', '"standin"\nstart = "on_left_foot"\nname = "all of it"')
    path = write(tmp_path, named.replace("[0.6, -0.25, 1.1]", "[0.5, -0.1, 1.0]") + more)
    problem, solver = load_problem(path), read_problem_file(path).solver
    default = ImpactProblem.collision_elements[0]
    assert problem.name == "all of it"
    assert problem.stance == OneSole("left")
    assert problem.swing == Phase(duration=(0.5, 0.9), intervals=9, grading=2.0)
    assert problem.follow == Phase(duration=1.5)
    assert problem.contact_duration == (0.004, 0.1)
    assert problem.collision_stages == 3
    assert problem.collision_elements == (default, (0.25, 0.75))
    assert (problem.collision, problem.coefficient_of_restitution) == ("full", 0.0)
    assert problem.scenarios == (
        Scenario(
            name="all of it",
            mass=1.5,
            stiffness=2,
            damping=0,
            torque=0.9,
            cone_margin=0.01,
            capture_margin=0.03,
        ),
        Scenario(name="nothing there", missing=True),
    )
    assert (problem.smoothness, problem.wrench_price) == (1e-5, 2e-3)
    assert problem.term(terms.TorqueLimit) == terms.TorqueLimit(fraction=0.7, collision=0.8)
    assert problem.term(terms.VelocityLimit) == terms.VelocityLimit(fraction=0.6)
    assert problem.term(terms.PositionLimit) == terms.PositionLimit(margin=0.03)
    assert problem.term(terms.ContactWrenchCone) == terms.ContactWrenchCone(
        friction=0.5, margin=0.01, collision_margin=0.015, minimum_force=20
    )
    assert problem.term(terms.Balance) == terms.Balance(
        capture_margin=0.03, vertical_speed=0.15, angular_momentum=6
    )
    assert problem.term(terms.Incidence) == terms.Incidence(speed=0.1)
    assert problem.objectives == (
        objectives.Impulse(weight=2.0),
        objectives.PeakForce(weight=-0.02),
        objectives.TargetEnergy(weight=0.5),
        objectives.Penetration(),
        objectives.AngularMomentum(weight=0.1),
        objectives.Effort(),
    )
    assert (solver.name, solver.time_limit) == ("ipm", 12)
    assert solver.options == {"ipopt": {"max_iter": 77}, "ipm": {"max_iterations": 99, "price": 50.0}}


EXTRA = """
[terms.torque_rate]
limit_N_m_s = {arm_right_4_joint = 300}
[terms.self_collision]
margin_m = 0.03
[terms.keep_out]
enabled = false
[terms.hand_orientation]
axis = [0.0, 0.0, 1.0]
direction = [0.0, 0.0, -1.0]
angle_rad = 0.3
[terms.gaze]
frame = "head_2_link"
axis = [1.0, 0.0, 0.0]
angle_rad = 0.4
since = 0.2
[terms.hit_region]
size_m = [0.1, 0.2]
[terms.hit_cone]
angle_rad = 0.15
"""


def test_extra_terms_reach_the_problem(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path, GOOD + EXTRA))
    assert problem.terms == (
        terms.SelfCollision(margin=0.03),
        terms.KeepOut(enabled=False),
        terms.TorqueRate(limit={"arm_right_4_joint": 300}),
        terms.HandOrientation(axis=(0, 0, 1), direction=(0, 0, -1), angle=0.3),
        terms.Gaze(frame="head_2_link", axis=(1, 0, 0), angle=0.4, since=0.2),
        terms.HitRegion(size=(0.1, 0.2)),
        terms.HitCone(angle=0.15),
    )
    disc = load_problem(write(tmp_path, GOOD + "[terms.hit_region]\nradius_m = 0.05\n"))
    assert disc.terms == (terms.HitRegion(radius=0.05),)


WORLD = """
[target.body]
shape = "box"
size_m = [0.2, 0.3, 0.1]
[[obstacles]]
name = "table"
size_m = [0.5, 0.6, 0.1]
position_m = [1.5, 0.0, 0.7]
rpy_rad = [0.0, 0.0, 0.3]
[[obstacles]]
name = "post"
start_m = [1.5, 1.0, 0.0]
end_m = [1.5, 1.0, 2.0]
radius_m = 0.05
[[obstacles]]
name = "lamp"
start_m = [0.0, 0.0, 2.5]
radius_m = 0.1
"""


def test_the_world_reaches_the_problem(tmp_path: Path) -> None:
    problem = load_problem(write(tmp_path, GOOD + WORLD))
    assert problem.body == TargetBody(shape="box", size=(0.2, 0.3, 0.1))
    lamp = Obstacle(name="lamp", start=(0.0, 0.0, 2.5), radius=0.1)
    assert lamp.end == lamp.start
    assert problem.obstacles == (
        Obstacle(name="table", size=(0.5, 0.6, 0.1), position=(1.5, 0.0, 0.7), rpy=(0.0, 0.0, 0.3)),
        Obstacle(name="post", start=(1.5, 1.0, 0.0), end=(1.5, 1.0, 2.0), radius=0.05),
        lamp,
    )
    ball = load_problem(write(tmp_path, GOOD + '[target.body]\nshape = "ball"\nsize_m = [0.1]\n'))
    assert ball.body == TargetBody(shape="ball", size=(0.1,))
    assert len({ball.hash, problem.hash, load_problem(write(tmp_path, GOOD)).hash}) == 3


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('shape = "box"', 'shape = "bx"', ["[target.body]", "shape", "'box'"]),
        ("size_m = [0.2, 0.3, 0.1]", "size_m = [0.2, 0.3]", ["[target.body]", "TargetBody.size"]),
        ("size_m = [0.2, 0.3, 0.1]", "size_m = [0.2, 0.3, 0.0]", ["[target.body] size_m", "0"]),
        ('shape = "box"', 'shape = "none"', ["[target.body]", "lengths > 0, and none of shape 'none'"]),
        ("size_m = [0.5, 0.6, 0.1]\n", "", ["obstacle 'table'", "either size, of a box"]),
        ("size_m = [0.5, 0.6, 0.1]", "size_m = [0.5, 0.6, -0.1]", ["obstacle 'table'", "> 0"]),
        ("radius_m = 0.05\n", "", ["obstacle 'post'", "radius > 0"]),
        ("radius_m = 0.1", "radius_m = 0.0", ["radius_m", "0"]),
        ("radius_m = 0.05", "radius_m = 0.05\nrpy_rad = [0.1, 0.0, 0.0]", ["'post'", "no position or rpy"]),
        ('name = "post"', 'name = "table"', ["two obstacles are called 'table'"]),
        ('name = "post"', 'name = " "', ["name is ' '"]),
        ('name = "post"\n', "", ["obstacles", "name", "missing"]),
    ],
)
def test_mistakes_about_the_world_are_named(tmp_path: Path, old: str, new: str, parts: list[str]) -> None:
    assert old in WORLD
    text = message(write(tmp_path, GOOD + WORLD.replace(old, new)))
    assert [part for part in parts if part not in text] == []


def test_links_that_may_pass_through_each_other(tmp_path: Path) -> None:
    pair = ("torso_2_link", "arm_right_7_link")
    section = f'[robot]\npreset = "talos"\ndisable_collisions = [["{pair[0]}", "{pair[1]}"]]\n'
    text = GOOD.replace('robot = "talos"', "") + section
    plain, robot = load_problem(write(tmp_path, GOOD)).robot, load_problem(write(tmp_path, text)).robot
    assert set(robot.disable_collisions) - set(plain.disable_collisions) == {pair}
    assert len(plain.disable_collisions) > 10, "the SRDF's"
    wrong = message(write(tmp_path, text.replace("arm_right_7_link", "arm_right_8_link")))
    assert "disable_collisions" in wrong and "did you mean 'arm_right_" in wrong
    for few in ('[["torso_2_link"]]', '["torso_2_link", "arm_right_7_link"]'):
        wrong = text.replace(f'[["{pair[0]}", "{pair[1]}"]]', few)
        assert "[robot] disable_collisions" in message(write(tmp_path, wrong))


RATE = "[terms.torque_rate] limit_N_m_s"


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("limit_N_m_s = {arm_right_4_joint = 300}", "limit_N_m_s = 0", [RATE, "> 0, or a table"]),
        ("{arm_right_4_joint = 300}", "{arm_right_4_joint = 0}", [RATE, "> 0, or a table"]),
        ("margin_m = 0.03", "margin_m = -0.03", ["[terms.self_collision] margin_m", "-0.03"]),
        ("enabled = false", "enabled = 0", ["[terms.keep_out] enabled", "true or false"]),
        ("angle_rad = 0.15", "angle_rad = 1.6", ["[terms.hit_cone]", "between 0 and pi/2"]),
        ("size_m = [0.1, 0.2]", "size_m = [0.1, 0.6]", ["[terms.hit_region]", "0.2 m"]),
        ("size_m = [0.1, 0.2]", "radius_m = 0.1\nsize_m = [0.1, 0.2]", ["either radius", "or size"]),
        ("since = 0.2", "since = 1.2", ["Gaze.since", "0 to 1"]),
        ("axis = [1.0, 0.0, 0.0]", "axis = [1.0, 1.0, 0.0]", ["[terms.gaze] axis", "unit vector"]),
        (
            "[terms.hit_cone]\nangle_rad",
            "[terms.hit_cone]\nangle_deg",
            ["angle_deg", "did you mean 'angle_rad'"],
        ),
        ("[terms.keep_out]", "[terms.keepout]", ["[terms] keepout", "did you mean 'keep_out'"]),
        ("[terms.hit_cone]", "[terms.incidence]\n[terms.hit_cone]", ["HitCone takes the place of Incidence"]),
        ("head_2_link", "head_3_link", ["Gaze", "no frame 'head_3_link'", "did you mean"]),
        (
            "{arm_right_4_joint",
            "{arm_right_4_link",
            ["TorqueRate", "no joint", "did you mean 'arm_right_4_joint'"],
        ),
    ],
)
def test_mistakes_in_extra_terms_are_named(tmp_path: Path, old: str, new: str, parts: list[str]) -> None:
    assert old in EXTRA
    text = message(write(tmp_path, GOOD + EXTRA.replace(old, new)))
    assert [part for part in parts if part not in text] == []


def test_what_a_file_leaves_out_is_the_problems_own_default(tmp_path: Path) -> None:
    given = read_problem_file(write(tmp_path, GOOD)).content.arguments()
    assert given.keys() == {"striker", "point", "normal", "law", "target"}


def test_every_field_of_what_a_file_describes_has_a_key() -> None:
    """A new field of a term, a phase or the problem that no file could set would be found here."""

    def below(section: type[Section]) -> list[type[Section]]:
        return [section, *(s for inner in section.__subclasses__() for s in below(inner))]

    kinds = {section.kind: section for section in below(Section) if section.kind is not None}
    described = (*objectives.OBJECTIVES, *terms.TERMS, Obstacle, TargetBody, *LAWS, *TARGETS)
    for kind in (Phase, Scenario, Tool, *described):
        keys = set(kinds[kind].model_fields) - {kinds[kind].choice, *kinds[kind].apart}
        elsewhere = {"grip"} if kind is Tool else set()  # [robot.grips.NAME]
        assert {f.name for f in dataclasses.fields(kind)} - elsewhere == keys
    keys = {
        *sections.File.model_fields,
        *sections.ProblemSection.model_fields,
        *sections.ObjectiveSection.model_fields,
    }
    keys |= {*sections.CollisionSection.model_fields, "law", "collision_elements", *kinds[FreeMass].apart}
    keys |= set(robot_sections.RobotSection.model_fields) & {"gains"}  # [[robot.gains]]
    assert {f.name for f in dataclasses.fields(ImpactProblem)} <= keys


@pytest.mark.usefixtures("no_robots")
@pytest.mark.parametrize(
    ("section", "made"),
    [
        ("[target]\nkind = 'free mass'\nmass_kg = 2", FreeMass(mass=2.0)),
        ("[target]\nkind = 'wall'", RigidWall()),
        ("[target]\nkind = 'nail'\nmass_kg = 0.1\nresistance_N = 300", Nail(mass=0.1, resistance=300.0)),
        (
            "[target]\nkind = 'nail'\nmass_kg = 0.1\nresistance_N = 300\nhardening_N_m = 1e4\ndepth_m = 0.02",
            Nail(mass=0.1, resistance=300.0, hardening=1e4, depth=0.02),
        ),
        (
            "[target]\nkind = 'board'\nmass_kg = 0.3\nstiffness_N_m = 1e5\nbreaking_force_N = 900\n"
            "damping_N_s_m = 5",
            Board(mass=0.3, stiffness=1e5, breaking_force=900.0, damping=5.0),
        ),
        (
            "[contact]\nlaw = 'spring damper'\nstiffness_N_m = 1e4\ndamping_N_s_m = 30",
            SpringDamper(stiffness=1e4, damping=30.0),
        ),
        (
            "[contact]\nlaw = 'Kelvin-Voigt'\nstiffness_N_m = 1e4\ndamping_N_s_m = 30",
            KelvinVoigt(stiffness=1e4, damping=30.0),
        ),
        (
            "[contact]\nlaw = 'Hunt-Crossley'\nstiffness_N_mp = 1e6\ndissipation_s_m = 0.2\nexponent = 2",
            HuntCrossley(stiffness=1e6, dissipation=0.2, exponent=2.0),
        ),
        (
            "[contact]\nlaw = 'Hertz'\nstiffness_N_m1_5 = 1e6\ndamping_N_s_m1_25 = 30",
            HertzDamped(stiffness=1e6, damping=30.0),
        ),
    ],
)
def test_every_kind_of_target_and_law_can_be_written(tmp_path: Path, section: str, made: object) -> None:
    kind, rest = section.split("\n", 1)
    old = {"[target]": "mass_kg = 5.0", "[contact]": "stiffness_N_m = 1e4\ndamping_N_s_m = 300.0"}[kind]
    assert old in GOOD
    given = read_problem_file(write(tmp_path, GOOD.replace(old, rest))).content.arguments()
    assert made in (given["target"], given["law"])


@pytest.mark.usefixtures("no_robots")
@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("mass_kg = 5.0", "kind = 'wal'", ["[target] kind", "'wal' is unknown", "did you mean 'wall'"]),
        (
            "mass_kg = 5.0",
            "kind = 'wall'\nmass_kg = 5.0",
            ["[target] mass_kg", "unknown key", "known are kind"],
        ),
        ("mass_kg = 5.0", "kind = 'nail'\nmass_kg = 5.0", ["[target] resistance_N", "missing"]),
        (
            "mass_kg = 5.0",
            "kind = 'nail'\nresistance_N = 0",
            ["2 mistakes", "mass_kg: missing", "0; give", "> 0"],
        ),
        ("mass_kg = 5.0", "kind = 3", ["[target] kind", "3 is unknown"]),
        ("mass_kg = 5.0", "mass_kg = 5.0\nresistance_N = 3", ["resistance_N", "unknown key", "mass_kg"]),
        ("stiffness_N_m = 1e4", "law = 'Herz'", ["[contact] law", "did you mean 'Hertz'"]),
        (
            "stiffness_N_m = 1e4",
            "law = 'Hertz'",
            ["2 mistakes", "stiffness_N_m1_5", "damping_N_s_m", "unknown"],
        ),
    ],
)
def test_a_kinds_keys_are_its_own(tmp_path: Path, old: str, new: str, parts: list[str]) -> None:
    text = message(write(tmp_path, GOOD.replace(old, new)))
    for part in parts:
        assert part in text, text


@pytest.mark.slow
def test_the_collisions_model_reaches_the_problem(tmp_path: Path) -> None:
    rigid = '[collision]\nmodel = "rigid"\ncoefficient_of_restitution = 0.4\n'
    problem = load_problem(write(tmp_path, GOOD + rigid))
    assert (problem.collision, problem.coefficient_of_restitution) == ("rigid", 0.4)
    assert problem.collision_elements == ImpactProblem.collision_elements
    problem = load_problem(write(tmp_path, GOOD + '[collision]\nmodel = "virtual-mass"\n'))
    assert problem.collision == "virtual-mass"
    for name in COLLISIONS:
        load_problem(write(tmp_path, GOOD + f'[collision]\nmodel = "{name}"\n'))
    assert "leave it out" in message(write(tmp_path, GOOD + rigid.replace('"rigid"', '"full"')))
    scenario = "[[scenarios]]\nname = 'a'\n"
    assert "scenarios need" in message(write(tmp_path, GOOD + rigid + scenario))
    assert "two scenarios are called 'a'" in message(write(tmp_path, GOOD + 2 * scenario))


@pytest.mark.usefixtures("no_robots")
@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("mass_kg", "mas_kg", ["line 8", "[target]", "mas_kg", "did you mean 'mass_kg'"]),
        ("[target]", "[tagret]", ["tagret", "unknown section", "did you mean 'target'"]),
        ("mass_kg = 5.0", "mass_kg = nan", ["line 8", "nan", "finite"]),
        ("mass_kg = 5.0", "mass_kg = -5.0", ["line 8", "[target] mass_kg", "-5.0", "> 0"]),
        ("mass_kg = 5.0", "mass_kg = '5'", ["'5'", "give a number"]),
        ("mass_kg = 5.0", "mass_kg = true", ["True", "give a number"]),
        ("mass_kg = 5.0", "", ["[target] mass_kg", "missing"]),
        ("300.0", "-1", ["damping_N_s_m", "-1", ">= 0"]),
        ("1e4", "inf", ["stiffness_N_m", "inf", "finite"]),
        ("1e4", "0", ["stiffness_N_m", "0", "> 0"]),
        ("[1.0, 0.0, 0.0]", "[1.0, 1.0, 0.0]", ["normal", "1.41421", "unit vector", "0.707107"]),
        ("[1.0, 0.0, 0.0]", "[0.0, 0.0, 0.0]", ["normal", "length 0", "unit vector"]),
        ("[1.0, 0.0, 0.0]", "[1.0, nan, 0.0]", ["normal[1]", "nan"]),
        ("[0.6, -0.25, 1.1]", "[0.6, -0.25]", ["point_m", "2 values", "give 3"]),
        ("[0.6, -0.25, 1.1]", "0.6", ["point_m", "0.6", "list"]),
        ('"talos"', '"talso"', ["line 2", "talso", "did you mean 'talos'", "g1"]),
        ('robot = "talos"', "", ["robot", "missing"]),
        ("[target]", "[robot]\npreset = 'g1'\n[target]", ["robot", "twice"]),
        ("[target]", "[swing]\nduration_s = [0.9, 0.5]\n[target]", ["duration_s", "0.9", "not exceed"]),
        ("[target]", "[swing]\nduration_s = -1\n[target]", ["duration_s", "-1", "> 0"]),
        ("[target]", "[swing]\nduration_s = 1\nintervals = 3\n[target]", ["[swing]", "6 to 2000", "3"]),
        ("[target]", "[terms.torque_limit]\nfraction = 85\n[target]", ["fraction", "85", "> 0 and <= 1"]),
        (
            "[target]",
            "[terms.torque_limits]\nfraction = 1\n[target]",
            ["[terms] torque_limits", "did you mean 'torque_limit'"],
        ),
        (
            "[target]",
            "[objectives.peak_farce]\n[target]",
            ["line 7", "[objectives] peak_farce", "did you mean 'peak_force'"],
        ),
        ("[target]", "[objectives.effort]\nweight = -1\n[target]", ["[objectives.effort]", "> 0", "-1"]),
        ("[target]", "[collision]\ncompression = [0.5, 0.6]\n[target]", ["compression", "1.1", "sum to 1"]),
        (
            "[target]",
            "[collision]\nmodel = 'rigit'\n[target]",
            ["line 8", "[collision] model", "did you mean 'rigid'", "'virtual-mass'"],
        ),
        (
            "[target]",
            "[collision]\ncoefficient_of_restitution = 1.5\n[target]",
            ["coefficient_of_restitution", "1.5", ">= 0 and <= 1"],
        ),
        (
            "[target]",
            "[[scenarios]]\nname = 'a'\nmas = 2\n[target]",
            ["line 9", "[scenarios] mas", "did you mean 'mass'"],
        ),
        ("[target]", "[[scenarios]]\nmass = 2\n[target]", ["line 7", "[scenarios] name", "missing"]),
        ("[target]", "[[scenarios]]\nname = 'a'\nmass = 0\n[target]", ["line 9", "mass", "> 0"]),
        ("[target]", "[[scenarios]]\nname = 'a'\nmissing = 1\n[target]", ["missing", "true or false"]),
        ("[target]", "[[scenarios]]\nname = 'a'\ntorque = inf\n[target]", ["torque", "inf", "finite"]),
        (
            "[target]",
            "[[scenarios]]\nname = 'a'\nmissing = true\nmass = 2\n[target]",
            ["line 7", "scenario 'a'", "drop mass"],
        ),
        ("[target]", "[[scenarios]]\nname = ''\n[target]", ["scenario's name", "give a word"]),
        ("[target]", "[scenarios]\nname = 'a'\n[target]", ["scenarios", "list"]),
        ("[target]", "[solver]\nname = 'ipotp'\n[target]", ["ipotp", "did you mean 'ipopt'"]),
        ("[target]", "[solver.ipopt]\nmax_itr = 3\n[target]", ["[solver]", "max_itr"]),
        (
            "[target]",
            "[solver.ipm]\nbarier = 3\n[target]",
            ["[solver.ipm]", "barier", "did you mean 'barrier'"],
        ),
        (
            "[target]",
            "[solver]\nname = 'sqp'\n[solver.sqp]\nqp_solver = 'osq'\n[target]",
            ["qp_solver", "did you mean 'osqp'"],
        ),
        ("[target]", "[solver]\ntime_limit_s = 0\n[target]", ["time_limit_s", "> 0"]),
    ],
)
def test_a_mistake_is_named_with_the_fix_before_a_robot_is_built(
    tmp_path: Path, old: str, new: str, parts: list[str]
) -> None:
    assert old in GOOD
    text = message(write(tmp_path, GOOD.replace(old, new)))
    assert [part for part in parts if part not in text] == []
    assert "\n" not in text, "one mistake, one line"


@pytest.mark.usefixtures("no_robots")
def test_all_mistakes_are_named_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = GOOD.replace("talos", "talo").replace("mass_kg = 5.0", "mass_kg = nan").replace("300.0", "-1")
    rows = message(write(tmp_path, text)).splitlines()
    assert "3 mistakes" in rows[0]
    assert [row.split(",")[0].strip() for row in rows[1:]] == ["line 2", "line 8", "line 12"]


def test_unknown_names_of_a_robots_parts_are_named_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("right_hand", "right_hnd").replace("normal", 'start = "half_siting"\nnormal')
    text = message(write(tmp_path, text + '[stance]\nsoles = "lef"\n'))
    for meant in ("right_hand", "half_sitting", "left"):
        assert f"did you mean {meant!r}" in text
    assert "3 mistakes" in text


def test_names_of_a_robots_parts_are_looked_up_beside_other_mistakes(tmp_path: Path) -> None:
    text = GOOD.replace("right_hand", "right_hnd").replace("normal", 'start = "half_siting"\nnormal')
    text = text.replace("mass_kg = 5.0", "mass_kg = nan").replace("300.0", "-1").replace("[contact]", "[law]")
    with pytest.raises(InputError) as caught:
        read_problem_file(write(tmp_path, text), names=True)
    found = str(caught.value)
    for part in ("did you mean 'right_hand'", "did you mean 'half_sitting'", "mass_kg: nan", "law: unknown"):
        assert part in found
    assert "5 mistakes" in found  # [contact] is missing


def test_soles_of_phases_and_a_wrong_phase_are_named_at_once(tmp_path: Path) -> None:
    text = PUNCH.with_name("punch_step.toml").read_text(encoding="utf-8").replace("right_hand", "right_hnd")
    text = text.replace('["left", "right"]', '["lft", "right"]').replace("intervals = 10", "intervals = 2")
    with pytest.raises(InputError) as caught:
        read_problem_file(write(tmp_path, text), names=True)
    found = str(caught.value)
    assert "did you mean 'right_hand'" in found and "a phase needs 6" in found
    assert found.count("did you mean 'left'") == 2
    assert "4 mistakes" in found


def test_a_point_out_of_reach_is_one_clear_message(tmp_path: Path) -> None:
    text = message(write(tmp_path, GOOD.replace("[0.6, -0.25, 1.1]", "[3.0, -0.25, 1.1]")))
    assert "out of reach" in text and "right_hand" in text and "problem.toml" in text


def test_files_that_are_no_problem_files(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    assert "did you mean 'problem.toml'" in message(tmp_path / "probelm.toml")
    assert "there is no file" in message(tmp_path / "nowhere" / "problem.toml")
    assert str(tmp_path) in message(tmp_path)
    assert "is not TOML" in message(write(tmp_path, "[problem\n", "broken.toml"))
    path.write_bytes(b"\xff\xfe\x00")
    assert "UTF-8" in message(path)
    assert "missing" in message(write(tmp_path, "", "empty.toml"))


def test_a_robot_of_ones_own_beside_the_file(tmp_path: Path) -> None:
    write(tmp_path, ARM, "arm.urdf")
    robot = """
[robot]
urdf = "arm.urdf"
name = "my arm"
floating = false
armature_kg_m2 = 0.05
kd_N_m_s_rad = {turn = 20.0}
torque_limit_N_m = 50.0
position_limit_rad = {turn = [-1.0, 1.5]}
postures_rad = {bent = {turn = 0.5, bend = 0.5}}
[[robot.strikers]]
name = "fist"
frame = "fist"
point_m = [0.0, 0.0, 0.1]
"""
    text = GOOD.replace('robot = "talos"', 'start = "bent"').replace("right_hand", "fist") + robot
    text = text.replace("[0.6, -0.25, 1.1]", "[0.4, -0.25, 1.1]")
    problem = load_problem(write(tmp_path, text))
    assert problem.robot.name == "my arm" and problem.stance == FixedBase()
    np.testing.assert_array_equal(problem.robot.torque_limit, 50.0)
    np.testing.assert_array_equal(problem.robot.armature, 0.05)
    assert problem.robot.kd[0] == 20.0
    assert (problem.robot.lower[0], problem.robot.upper[0]) == (-1.0, 1.5)
    np.testing.assert_allclose(problem.start_posture, [0.5, 0.5, 0.0])
    assert "one of preset, urdf and mjcf" in message(write(tmp_path, text.replace('urdf = "arm.urdf"', "")))
    assert "[robot]" in message(write(tmp_path, text.replace("arm.urdf", "leg.urdf")))
    assert "did you mean 'turn'" in message(write(tmp_path, text.replace("{turn = 20.0}", "{trun = 20.0}")))
    assert "fixed base" in message(write(tmp_path, text + '[stance]\nsoles = "both"\n'))


def test_a_preset_with_changes_keeps_its_strikers(tmp_path: Path) -> None:
    robot = """
[robot]
preset = "talos"
kp_N_m_rad = 3000.0
[[robot.strikers]]
name = "elbow"
frame = "arm_right_4_link"
point_m = [0.0, 0.0, -0.05]
"""
    problem = load_problem(write(tmp_path, GOOD.replace('robot = "talos"', "") + robot))
    assert {*talos().strikers, "elbow"} == set(problem.robot.strikers)
    np.testing.assert_array_equal(problem.robot.kp, 3000.0)


KEY = st.text("az09_-", max_size=8).map("k".__add__)


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(KEY, st.dictionaries(KEY, st.integers(), max_size=4), max_size=4))
def test_keys_are_found_on_their_lines(tables: dict[str, dict[str, int]]) -> None:
    lines: list[str] = []
    expected: dict[tuple[str, ...], int] = {}
    for table, keys in tables.items():
        lines += ["# comment", f"[{table}]  # of a section"]
        expected[(table,)] = len(lines)
        for key, value in keys.items():
            lines.append(f"{key} = {value}")
            expected[table, key] = len(lines)
    assert key_lines("\n".join(lines)) == expected
