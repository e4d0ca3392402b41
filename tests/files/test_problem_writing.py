"""From a problem to its file and back: every problem of the package, and made-up ones."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.problem_texts import ARM, write
from support.small_robots import arm
from support.term_cases import CASES

import impactopt
from impactopt import (
    FixedBase,
    Ground,
    ImpactProblem,
    InputError,
    Obstacle,
    OneSole,
    Phase,
    Robot,
    Scenario,
    Sole,
    Striker,
    TargetBody,
    Tool,
    contact,
    load_problem,
    problem_names,
    write_problem,
)
from impactopt.files.problem_file import ProblemFile, SolverSettings, read_problem_file, read_toml
from impactopt.files.problem_file.reference import problem_template, reference
from impactopt.files.sections.values import Section
from impactopt.problem import objectives, terms

ROOT = Path(__file__).parents[2]


def back(text: str, folder: Path = Path()) -> ImpactProblem:
    return ProblemFile.parse(text, folder / "written.toml").build()


def assert_same(a: ImpactProblem, b: ImpactProblem) -> None:
    """Field by field, beside the hash: the hash could be blind to something."""
    assert a.hash == b.hash
    for field in dataclasses.fields(ImpactProblem):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name == "robot":
            assert x.name == y.name
        elif field.name in ("start", "near_contact") and x is not None:
            postures = (p.robot.given_posture(given, name=field.name) for p, given in ((a, x), (b, y)))
            np.testing.assert_array_equal(*postures)
        elif field.name == "terms":
            assert {type(t): a.term(type(t)) for t in terms.DEFAULT_TERMS} == {
                type(t): b.term(type(t)) for t in terms.DEFAULT_TERMS
            }
        elif isinstance(x, np.ndarray):
            np.testing.assert_array_equal(x, y)
        elif field.name == "objectives":
            assert sorted(map(repr, x)) == sorted(map(repr, y))
        else:
            assert x == y, field.name


@pytest.mark.parametrize("name", problem_names())
def test_every_problem_of_the_package_comes_back(name: str) -> None:
    read = read_problem_file(name)
    problem = read.build()
    text = write_problem(problem, solver=read.solver)
    assert_same(back(text), problem)
    again = ProblemFile.parse(text, Path("written.toml"))
    assert again.solver == read.solver
    # nothing stands there that could be left out
    data = read_toml(text)
    for term, keys in data.get("terms", {}).items():
        section = type(again.content.terms).model_fields[term].annotation
        assert issubclass(section, Section)
        fields = {info.alias or n: n for n, info in section.model_fields.items()}
        assert all(section.defaults().get(fields[key]) != value for key, value in keys.items())
    explained, above = False, ""
    for line in text.splitlines():
        if line.startswith("["):  # a table by joint is explained above its name, once for all of them
            explained = above.startswith("# ") and "by joint" in above
        if " = " in line:
            assert explained or re.search(r" # \S", line), line
        above = line


@pytest.fixture(scope="module")
def nailing() -> ImpactProblem:
    return load_problem("arm_planar")


POSITIVE = st.floats(1e-3, 1e6)
SMALL = st.floats(1e-3, 0.5)
FRACTION = st.floats(0.01, 1.0)
SPLIT = st.floats(0.01, 0.99).map(lambda a: (a, 1.0 - a)) | st.just((1.0,))
SPAN = st.tuples(SMALL, SMALL).map(lambda ab: (min(ab), max(ab)))
PHASES = st.builds(Phase, duration=SPAN, intervals=st.integers(6, 30), grading=st.floats(1.0, 9.0))
NUMBERS = {"stiffness": POSITIVE, "damping": POSITIVE}
LAWS = st.one_of(
    st.builds(contact.SpringDamper, **NUMBERS),
    st.builds(contact.KelvinVoigt, **NUMBERS),
    st.builds(contact.HertzDamped, **NUMBERS),
    st.builds(contact.HuntCrossley, stiffness=POSITIVE, dissipation=SMALL, exponent=st.floats(1.0, 3.0)),
)
TARGETS = st.one_of(
    st.just(contact.RigidWall()),
    st.builds(contact.FreeMass, mass=POSITIVE | st.integers(1, 9)),
    st.builds(contact.Nail, mass=POSITIVE, resistance=POSITIVE, hardening=POSITIVE, depth=SMALL),
    st.builds(contact.Board, mass=POSITIVE, stiffness=POSITIVE, breaking_force=POSITIVE, damping=POSITIVE),
)
AXES = st.sampled_from([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.8, 0.0)])
ANY = SMALL | st.just(float("inf"))
TERMS: dict[str, st.SearchStrategy[Any]] = {
    "torque": st.builds(terms.TorqueLimit, fraction=FRACTION, collision=FRACTION),
    "velocity": st.builds(terms.VelocityLimit, fraction=FRACTION),
    "position": st.builds(terms.PositionLimit, margin=SMALL),
    "cone": st.builds(terms.ContactWrenchCone, friction=SMALL, margin=SMALL, minimum_force=POSITIVE),
    "balance": st.builds(
        terms.Balance, capture_margin=SMALL | st.none(), vertical_speed=ANY, angular_momentum=ANY
    ),
    "direction": st.builds(terms.Incidence, speed=ANY) | st.builds(terms.HitCone, angle=SMALL),
    "legs": st.builds(terms.LegExtension, minimum=st.floats(0, 1)),
    "rate": st.builds(
        terms.TorqueRate,
        limit=POSITIVE | st.dictionaries(st.sampled_from(["elbow", "wrist"]), POSITIVE, min_size=1),
    ),
    "self": st.builds(terms.SelfCollision, margin=SMALL, enabled=st.booleans()),
    "keep": st.builds(terms.KeepOut, margin=SMALL, enabled=st.booleans()),
    "hand": st.builds(terms.HandOrientation, axis=AXES, direction=st.none() | AXES, angle=SMALL),
    "gaze": st.builds(terms.Gaze, frame=st.just("elbow"), axis=AXES, angle=SMALL, since=FRACTION),
    "region": st.builds(terms.HitRegion, radius=st.floats(0.01, 0.19))
    | st.builds(terms.HitRegion, size=st.tuples(st.floats(0.01, 0.1), st.floats(0.01, 0.1))),
}
WEIGHT = st.floats(-9, 9).filter(lambda w: w != 0)
OBJECTIVES = st.lists(
    st.one_of(
        st.builds(objectives.Impulse, weight=WEIGHT),
        st.builds(objectives.PeakForce, weight=WEIGHT),
        st.builds(objectives.TargetEnergy, weight=WEIGHT),
        st.builds(objectives.Penetration, weight=WEIGHT),
        st.builds(objectives.Effort, weight=POSITIVE),
    ),
    min_size=1,
    unique_by=type,
).map(tuple)


def _undefined_energy(changes: dict[str, Any]) -> bool:
    """True of the energy of a damped board, which is refused; it is the objective if none is drawn."""
    target = changes.get("target")
    damped = isinstance(target, impactopt.Board) and target.damping > 0
    drawn = changes.get("objectives", (objectives.TargetEnergy(),))
    return damped and any(type(one) is objectives.TargetEnergy for one in drawn)


LETTERS = st.characters(exclude_categories=["Cc", "Cs"], include_characters="\n\t")
WORDS = st.text("ab \"'\\\n=#[", min_size=1).filter(lambda text: bool(text.strip()))
SCENARIOS = st.lists(
    st.builds(Scenario, name=WORDS, torque=SMALL, cone_margin=SMALL)
    | st.builds(
        Scenario, name=st.text("cd", min_size=1), missing=st.just(True), abort_after=st.none() | SMALL
    ),
    max_size=2,
    unique_by=lambda s: s.name,
).filter(lambda found: len({s.abort_after for s in found} - {None}) < 2)
SIDES = st.tuples(SMALL, SMALL, SMALL)
BODIES = st.one_of(
    st.builds(TargetBody, shape=st.none() | st.just("box"), size=st.none() | SIDES),
    st.builds(TargetBody, shape=st.just("ball"), size=st.none() | st.tuples(SMALL)),
    st.just(TargetBody(shape="none")),
)
OBSTACLES = st.lists(
    st.builds(Obstacle, name=WORDS, size=SIDES, position=SIDES, rpy=SIDES)
    | st.builds(Obstacle, name=WORDS, start=SIDES, end=st.none() | SIDES, radius=SMALL),
    max_size=2,
    unique_by=lambda o: o.name,
)
CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "law": LAWS,
        "target": TARGETS,
        "swing": PHASES,
        "follow": PHASES,
        "contact_duration": SPAN,
        "collision_elements": st.tuples(SPLIT, SPLIT),
        "collision_stages": st.sampled_from([2, 3]),
        "scenarios": SCENARIOS.map(tuple),
        "body": BODIES,
        "obstacles": OBSTACLES.map(tuple),
        "ground": st.none() | st.builds(Ground, height=st.floats(-2, 0)),
        "terms": st.fixed_dictionaries({}, optional=TERMS).map(lambda found: tuple(found.values())),
        "objectives": OBJECTIVES,
        "smoothness": SMALL,
        "wrench_price": SMALL,
        "return_price": SMALL,
        "name": st.text(LETTERS, max_size=8),
    },
).filter(lambda found: not _undefined_energy(found))


def goes_together(changes: dict[str, Any]) -> bool:
    """A plan for a nail, which the problem has if nothing else is drawn, wants a law of one branch."""
    nail = isinstance(changes.get("target"), contact.Nail) or "target" not in changes
    peaks = any(isinstance(o, objectives.Penetration) for o in changes.get("objectives", ()))
    return not nail or not (isinstance(changes.get("law"), contact.SpringDamper) or peaks)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(changes=CHANGES.filter(goes_together), turn=st.floats(-0.05, 0.05))
def test_any_problem_comes_back(nailing: ImpactProblem, changes: dict[str, Any], turn: float) -> None:
    start = nailing.start_posture + turn
    problem = dataclasses.replace(nailing, start=start if turn > 0 else "ready", **changes)
    assert_same(back(write_problem(problem)), problem)


@pytest.mark.parametrize("near", ["ready", "of its own", "of the robot alone"])
def test_a_posture_near_contact_comes_back(nailing: ImpactProblem, near: str) -> None:
    robot, posture = nailing.robot, nailing.contact_posture
    robot = dataclasses.replace(robot, postures={**robot.postures, "of the robot alone": posture})
    given = posture if near == "of its own" else near
    problem = dataclasses.replace(nailing, robot=robot, near_contact=given)
    assert_same(back(text := write_problem(problem)), problem)
    assert ('near_contact = "ready"' in text) is (near == "ready")


def test_an_unknown_posture_near_contact_is_named_with_its_line(nailing: ImpactProblem) -> None:
    text = write_problem(dataclasses.replace(nailing, near_contact="ready"))
    with pytest.raises(InputError, match=r"near_contact(.|\n)*did you mean 'ready'"):
        back(text.replace('near_contact = "ready"', 'near_contact = "redy"'))


@pytest.mark.parametrize("name", CASES)
def test_terms_that_only_some_problems_have_come_back(nailing: ImpactProblem, name: str) -> None:
    motor = impactopt.Actuator(stall_torque=200.0, no_load_speed=10.0)  # for the term that is about motors
    robot = nailing.robot.with_actuators({"wrist": motor})
    for term in (CASES[name].tight, CASES[name].mild):
        problem = dataclasses.replace(nailing, terms=(term,), robot=robot)
        again = back(write_problem(problem))
        assert_same(again, problem)
        assert again.terms == (term,)


def test_motors_of_all_joints_but_a_soft_grip_come_back(nailing: ImpactProblem) -> None:
    """The pattern * of a file is read before the grip, which no [[robot.actuators]] may name."""
    grip = impactopt.SoftGrip(axis=[0, 1, 0], stiffness=200.0, damping=2.0, point=[0.0, 0.0, 0.05])
    motor = impactopt.Actuator(power_limit=200.0)
    robot = nailing.robot.with_actuators({"*": motor}).with_grip("hammer", grip)
    problem = dataclasses.replace(nailing, robot=robot)
    assert_same(back(write_problem(problem)), problem)


def test_impacts_without_duration_and_one_foot_come_back() -> None:
    punch = load_problem("punch_one_foot")
    for changes in (
        {"collision": "rigid", "coefficient_of_restitution": 0.3, "scenarios": ()},
        {"collision": "virtual-mass", "scenarios": ()},
        {"terms": (terms.SelfCollision(margin=0.02), terms.KeepOut())},
        {"terms": (terms.SelfCollision(), terms.KeepOut(enabled=False))},
        {"stance": OneSole("left")},
    ):
        problem = dataclasses.replace(punch, **changes)
        text = write_problem(problem)
        assert_same(back(text), problem)
        assert "[obstacles" not in text and "[target.body]" not in text, "what is left out stays so"


def test_links_that_may_pass_through_each_other_come_back() -> None:
    """The preset's own ones, an SRDF's, are not written."""
    punch = load_problem("punch_one_foot")
    assert "disable_collisions" not in write_problem(punch)
    pair = (punch.robot.model.names[2], punch.robot.model.names[-1])
    robot = dataclasses.replace(punch.robot, disable_collisions=(*punch.robot.disable_collisions, pair))
    text = write_problem(dataclasses.replace(punch, robot=robot))
    assert read_toml(text)["robot"]["disable_collisions"] == [list(pair)]
    assert back(text).robot.disable_collisions == robot.disable_collisions


def changed_arm(**options: Any) -> ImpactProblem:
    base = load_problem("arm_planar")
    return dataclasses.replace(base, robot=impactopt.planar_arm(**options))


def _grip() -> impactopt.SoftGrip:
    return impactopt.SoftGrip(
        axis=[0.0, 0.6, 0.8], stiffness=30.0, damping=0.4, point=[0.0, 0.1, 0.0], range=0.8
    )


@pytest.mark.parametrize(
    "robot",
    [
        lambda: impactopt.load_robot("planar_arm", kp=2000.0),
        lambda: impactopt.planar_arm(torque_limit={"elbow": 90.0}, name="weaker"),
        lambda: impactopt.planar_arm(velocity_limit=np.array([4.0, 5.0, 6.0])),
        lambda: impactopt.planar_arm(armature=0.3),
        lambda: impactopt.planar_arm(position_limit={"wrist": (-1.5, 1.8)}),
        lambda: impactopt.planar_arm(postures={"ready": {"shoulder": -0.5, "elbow": 1.6, "wrist": 0.47}}),
        lambda: dataclasses.replace(impactopt.planar_arm(), kd=np.array([20.0, 10.0, 4.5])),
        lambda: dataclasses.replace(impactopt.planar_arm(kp=1500.0), kp=np.array([900.0, 800.0, 200.0])),
        lambda: impactopt.planar_arm().with_striker(Striker(name="elbow", frame="elbow", point=[0, 0, 0.1])),
        lambda: impactopt.planar_arm().with_tool(Tool.hammer(frame="elbow", name="second")),
        lambda: impactopt.planar_arm().with_grip("hammer", _grip()),
        lambda: (
            impactopt.planar_arm()
            .with_tool(Tool.hammer(frame="elbow", name="second"))
            .with_grip("second", _grip())
        ),
    ],
)
def test_a_preset_with_changes_comes_back(robot: Any, nailing: ImpactProblem) -> None:
    problem = dataclasses.replace(nailing, robot=robot())
    text = write_problem(problem)
    assert_same(back(text), problem)
    built = back(text).robot
    for name in ("kp", "kd", "torque_limit", "velocity_limit", "lower", "upper", "armature"):
        np.testing.assert_array_equal(getattr(built, name), getattr(problem.robot, name), name)
    assert read_toml(text)["robot"]["preset"] == "planar_arm"


def test_a_robot_from_a_urdf_comes_back(tmp_path: Path) -> None:
    path = write(tmp_path, ARM, "arm.urdf")
    robot = Robot.from_urdf(
        path,
        floating=False,
        armature=0.05,
        locked=("twist",),
        kd={"turn": 20.0},
        postures={"bent": {"turn": 0.5, "bend": 0.5}},
        strikers=[Striker(name="fist", frame="fist", point=[0.0, 0.0, 0.1])],
    ).with_tool(Tool.hammer(frame="fist", head_mass=0.2))
    problem = ImpactProblem(
        robot=robot,
        stance=FixedBase(),
        striker="fist",
        start="bent",
        point=_point(robot, "bent", "fist"),
        normal=[1.0, 0.0, 0.0],
        law=contact.SpringDamper(stiffness=1e4, damping=30.0),
        target=contact.FreeMass(mass=1.0),
    )
    text = write_problem(problem, folder=tmp_path)
    assert read_toml(text)["robot"]["urdf"] == "arm.urdf", "relative to the file's folder"
    assert_same(back(text, tmp_path), problem)
    elsewhere = write_problem(problem, folder=tmp_path / "other")
    assert_same(back(elsewhere, tmp_path / "other"), problem)


def test_soles_on_new_frames_come_back() -> None:
    corners = [[0.1, 0.05], [-0.1, 0.05], [-0.1, -0.05], [0.1, -0.05]]
    own = impactopt.standin().soles
    soles = [
        Sole(name=s.name, frame=f"my_{s.name}", polygon=corners, parent=s.parent, placement=s.placement)
        for s in own
    ]
    problem = dataclasses.replace(
        load_problem("punch_standin"), robot=impactopt.standin(soles=soles), scenarios=(), terms=()
    )
    assert_same(back(write_problem(problem)), problem)
    turned = pin.SE3(pin.utils.rotate("z", 0.1), own[0].placement.translation)
    tilted = [dataclasses.replace(sole, placement=turned) for sole in soles]
    problem = dataclasses.replace(problem, robot=impactopt.standin(soles=tilted))
    assert_same(back(write_problem(problem)), problem)


def test_what_is_made_of_functions_cannot_be_written(nailing: ImpactProblem) -> None:
    law = contact.CustomLaw(compression=lambda x, rate, k: k * x, k=1e4)
    with pytest.raises(InputError, match=r"law.*class in Python"):
        write_problem(dataclasses.replace(nailing, law=law))

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Heavier(contact.FreeMass):
        pass

    with pytest.raises(InputError, match="target Heavier"):
        write_problem(dataclasses.replace(nailing, target=Heavier(mass=1.0)))

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class MyLimit(terms.Term):
        name = "mine"

        def add_constraints(self, program: Any) -> None:
            pass

    with pytest.raises(InputError, match="no section for MyLimit"):
        write_problem(dataclasses.replace(nailing, terms=(MyLimit(),)))


def test_a_robot_made_in_python_cannot_be_written(nailing: ImpactProblem) -> None:
    robot = arm()
    made = dataclasses.replace(
        nailing,
        robot=robot,
        striker="hand",
        start="start",
        normal=[0, 1, 0],
        point=_point(robot, "start", "hand"),
        terms=(),
    )
    with pytest.raises(InputError, match=r"load_robot.*from_urdf"):
        write_problem(made)
    model = nailing.robot.model.copy()
    model.gravity.linear = np.array([0, 0, -1.62])
    moon = dataclasses.replace(nailing, robot=dataclasses.replace(nailing.robot, model=model))
    with pytest.raises(InputError, match="'planar_arm' has changes that a file cannot contain"):
        write_problem(moon)


def _point(robot: Robot, posture: str, striker: str) -> Any:
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, robot.posture(posture))
    return data.oMf[robot.model.getFrameId(robot.striker(striker).model_frame)].translation.copy()


def test_what_is_no_problem_cannot_be_written() -> None:
    with pytest.raises(InputError, match="problem must be an ImpactProblem, not 'arm_planar'"):
        write_problem("arm_planar")  # type: ignore[arg-type]


def test_solver_settings_are_written(nailing: ImpactProblem) -> None:
    solver = SolverSettings(
        name="ipopt", time_limit=3.5, options={"ipopt": {"tol": 1e-5}, "sqp": {"radius": 2.0}}
    )
    assert ProblemFile.parse(write_problem(nailing, solver=solver), Path("x.toml")).solver == solver


@pytest.mark.slow
@pytest.mark.parametrize("name", problem_names())
def test_a_template_is_the_same_problem_with_every_key_shown(name: str) -> None:
    text, problem = problem_template(name), load_problem(name)
    assert_same(back(text), problem)
    shown = re.sub(r"(?m)^# (\w+ = )", r"\1", text)
    assert shown.count(" = ") > read_problem_file(name).text.count("\n[")
    # a missing target has no numbers of a collision, nor a rigid impact's restitution a place in dynamics
    assert_same(back(shown), problem)
    assert "There may be more sections" in text


def test_every_key_is_described_with_its_unit() -> None:
    def below(section: type[Section]) -> list[type[Section]]:
        return [section, *(s for inner in section.__subclasses__() for s in below(inner))]

    letters = str.maketrans("", "", "_ /^.(),")
    own = {s for s in below(Section)[1:] if s.__module__.startswith("impactopt.files.problem_file")}
    for section in {section for section in own if section.__name__ != "File"}:
        assert section.__doc__ and section.__doc__ != Section.__doc__, section
        for name, info in section.model_fields.items():
            holds_sections = not info.description
            assert info.description or (holds_sections and info.alias is None)
            if info.alias and info.alias != name and info.alias.startswith(f"{name}_"):
                units = re.findall(r"\[([^\]]+)\]", info.description or "")
                wanted = info.alias.removeprefix(f"{name}_").translate(letters)
                assert wanted in [unit.translate(letters) for unit in units], (section, name)


def test_the_page_of_all_keys_is_the_one_in_docs() -> None:
    assert (ROOT / "docs" / "problem_files.md").read_text(encoding="utf-8") == reference(), (
        "run: impactopt new --reference > docs/problem_files.md"
    )
