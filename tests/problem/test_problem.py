"""Problems: what is wrong with one is said when it is written, before anything is built."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray
from support.small_robots import arm, biped

from impactopt import (
    Balance,
    BothSoles,
    ContactLaw,
    ContactWrenchCone,
    FirstTouch,
    FixedBase,
    FreeMass,
    GroundForce,
    ImpactProblem,
    Incidence,
    InputError,
    KeepOut,
    LegExtension,
    OneSole,
    Phase,
    PositionLimit,
    Robot,
    Scenario,
    SelfCollision,
    SpringDamper,
    Striker,
    Term,
    TorqueLimit,
    VelocityLimit,
    load_problem,
)
from impactopt.codegen import cache as codegen
from impactopt.planning.solve import solve
from impactopt.problem.terms import DEFAULT_TERMS

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spring(ContactLaw):
    """A law of one's own, with a number of its own."""

    rate: float

    def branch(self, penetration: Any, rate: Any, compressing: bool, parameters: Any = None) -> Any:
        return (parameters or self.parameters)["rate"] * penetration


@pytest.fixture(scope="module")
def robot() -> Robot:
    return biped()


@pytest.fixture(autouse=True)
def nothing_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bad input is refused before any function is built."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise AssertionError("functions are being built")

    monkeypatch.setattr(codegen, "cached_groups", refuse)
    monkeypatch.setattr("impactopt.transcription.transcription.cached_groups", refuse)


def problem(robot: Robot, **changes: Any) -> ImpactProblem:
    settings: dict[str, Any] = {
        "robot": robot,
        "striker": "fist",
        "point": [0.5, -0.15, 1.1],
        "normal": [1.0, 0.0, 0.0],
        "law": SpringDamper(stiffness=1e4, damping=300.0),
        "target": FreeMass(mass=3.0),
    }
    return ImpactProblem(**{**settings, **changes})


def posture(robot: Robot, **angles: float) -> Array:
    """The half-sitting posture with some joint angles changed (spaces in names as underscores)."""
    q = robot.posture("half_sitting")
    for name, angle in angles.items():
        q[7 + robot.joint_index(name.replace("_", " "))] = angle
    return q


def on_left(robot: Robot) -> Array:
    """A posture with the weight on the left sole, and the right foot in the air."""
    lean = {"left_hip_roll": -0.2, "left_ankle_roll": 0.2}
    q = posture(robot, right_hip_pitch=-0.8, right_knee=1.6, right_ankle_pitch=-0.8, **lean)
    return robot.place(q)


# ---- what a good one holds


def test_a_good_problem_has_numbers_and_a_contact_posture(robot: Robot) -> None:
    p = problem(robot)
    assert p.point.dtype == np.float64
    np.testing.assert_array_equal(p.start_posture, robot.posture("half_sitting"))
    assert p.contact_posture.shape == (robot.nq,)
    assert p.coordinates.nl == 12
    json.dumps(p.describe())  # goes into summary.json
    assert p.describe()["striker"] == "fist"


def test_a_normal_within_rounding_of_a_unit_vector_is_made_one(robot: Robot) -> None:
    p = problem(robot, normal=[0.70710678, 0.70710678, 0.0])
    assert np.linalg.norm(p.normal) == pytest.approx(1, abs=1e-15)


def test_a_start_may_be_a_configuration(robot: Robot) -> None:
    q = posture(robot, elbow=1.0)
    np.testing.assert_array_equal(problem(robot, start=q).start_posture, q)


def test_a_knee_strikes_of_a_leg_that_does_not_stand(robot: Robot) -> None:
    """Joints of a standing leg follow from the others in a plan, and the striker would not know."""
    robot = robot.with_striker(Striker(name="knee", frame="right knee", point=np.array([0.05, 0.0, 0.0])))
    q = on_left(robot)
    there = q.copy()
    there[7 + robot.joint_index("right hip pitch")] -= 0.1
    model = robot.model
    data, frame = model.createData(), model.getFrameId("striker:knee")
    places = []
    for at in (q, there):
        pin.framesForwardKinematics(model, data, at)
        places.append(data.oMf[frame].translation.copy())
    way = places[1] - places[0]
    hit = {"striker": "knee", "point": places[1], "normal": way / np.linalg.norm(way)}
    assert problem(robot, start=q, stance=OneSole("left"), **hit).contact_posture.shape == (robot.nq,)
    with pytest.raises(InputError, match="the sole 'right' stands, so it cannot carry the striker 'knee'"):
        problem(robot, **hit)


def test_inputs_are_copied(robot: Robot) -> None:
    point, start = np.array([0.5, -0.15, 1.1]), np.array(robot.posture("half_sitting"))
    p = problem(robot, point=point, start=start)
    point[:] = start[:] = 9
    assert p.point[0] == 0.5
    np.testing.assert_array_equal(p.start, p.start_posture)
    assert p.start_posture is not p.start and 9 not in p.start_posture


@pytest.mark.parametrize(
    ("stance", "legs"), [(BothSoles(), ["left", "right"]), (OneSole("left"), ["left"])], ids=["both", "one"]
)
def test_the_stance_decides_which_soles_are_held(robot: Robot, stance: Any, legs: list[str]) -> None:
    start = on_left(robot) if len(legs) == 1 else "half_sitting"
    assert [leg.sole.name for leg in problem(robot, start=start, stance=stance).coordinates.legs] == legs


def test_a_start_that_cannot_be_held_at_rest_is_named(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"centre of mass is \d+ mm outside the support polygon of left;"):
        problem(robot, stance=OneSole("left"))


def test_a_fixed_base_holds_no_soles() -> None:
    p = problem(arm(), striker="hand", start="start", stance=FixedBase(), point=[0.45, 0.2, 0.8])
    assert p.coordinates.legs == []
    assert p.coordinates.ny == 4


# ---- bad input, one clear error each


def test_a_normal_along_which_no_joint_moves_is_refused() -> None:
    """A planar arm has none across its plane: there its mass would be infinite."""
    with pytest.raises(InputError, match=r"no joint.*'hammer'.*\[0.0, 1.0, 0.0\].*turn the normal"):
        dataclasses.replace(load_problem("arm_planar"), normal=[0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"point": [np.nan, 0, 1]}, r"point.*nan"),
        ({"point": [0.5, 0.1]}, r"point.*shape \(3\)"),
        ({"point": "there"}, "point.*numbers"),
        ({"normal": [1, 0, np.inf]}, "normal"),
        ({"normal": [1, 0]}, r"normal.*shape \(3\)"),
        ({"normal": [2.0, 0, 0]}, r"normal.*unit vector.*length is 2.*did you mean \[1.0, 0.0, 0.0\]"),
        ({"normal": [0, 0, 0]}, "normal.*unit vector.*length is 0"),
        ({"striker": "fits"}, "no striker 'fits'.*did you mean 'fist'"),
        ({"start": "half_siting"}, "no posture 'half_siting'.*did you mean 'half_sitting'"),
        ({"point": [2.5, 0.0, 1.0]}, r"\[2.5, 0.0, 1.0\].*out of reach of 'fist'.*nearer"),
        ({"stance": OneSole("lft")}, "no sole 'lft'.*did you mean 'left'"),
        ({"stance": FixedBase()}, "free-flyer"),
        ({"contact_duration": (-0.1, 0.1)}, "contact_duration"),
        ({"contact_duration": (0.0, 0.0)}, "contact_duration"),
        ({"contact_duration": (0.2, 0.1)}, "contact_duration"),
        ({"contact_duration": (np.nan, 0.1)}, "contact_duration"),
        ({"collision_elements": ((0.5, 0.4), (1.0,))}, r"collision_elements.*\(0.5, 0.4\)"),
        ({"collision_elements": ((1.5, -0.5), (1.0,))}, "collision_elements"),
        ({"collision_elements": ((), (1.0,))}, "collision_elements"),
        ({"collision_elements": ((1.0,),)}, "collision_elements"),
        ({"terms": (Incidence(), Incidence(speed=0.1))}, "two terms of kind Incidence"),
        ({"name": "a\x1b[2Jb"}, "the problem's name 'a.*control characters"),
        ({"name": 3}, "the problem's name is 3"),
        ({"smoothness": -1.0}, "smoothness"),
        ({"wrench_price": np.nan}, "wrench_price"),
        ({"stance": BothSoles(base_mass=1e6, base_inertia=1e6)}, "virtual base"),
        (
            {"collision": "rigd"},
            "unknown collision 'rigd'.*did you mean 'rigid'.*rigid, virtual-mass, sdc-paper, sdc, full, auto",
        ),
        ({"collision": "rigid", "coefficient_of_restitution": -0.1}, "between 0 and 1, not -0.1"),
        ({"collision": "rigid", "coefficient_of_restitution": 1.1}, "between 0 and 1, not 1.1"),
        ({"collision": "rigid", "coefficient_of_restitution": np.nan}, "coefficient_of_restitution: nan"),
        ({"coefficient_of_restitution": 0.5}, "for collision=\"rigid\"; with 'full' leave it out"),
        (
            {"collision": "virtual-mass", "coefficient_of_restitution": 0.5},
            "with 'virtual-mass' leave it out",
        ),
        ({"collision": "virtual-mass", "law": Spring(rate=1e4)}, "SpringDamper only, not Spring"),
        ({"collision": "rigid", "scenarios": (Scenario(name="a"),)}, "scenarios need.*full.*not 'rigid'"),
        ({"scenarios": (Scenario(name="a"), Scenario(name="a", mass=2.0))}, "two scenarios are called 'a'"),
        (
            {
                "scenarios": tuple(
                    Scenario(name=str(time), missing=True, abort_after=time) for time in (0.1, 0.02)
                )
            },
            r"abort_after of 0\.02 and 0\.1 s, and a plan has one abort motion",
        ),
        ({"scenarios": Scenario(name="a")}, r"a tuple of Scenario, not Scenario\("),
        ({"scenarios": ("heavy",)}, r"a tuple of Scenario, not \('heavy',\)"),
        (
            {"law": Spring(rate=1e4), "scenarios": (Scenario(name="stiff", stiffness=2.0),)},
            "scenario 'stiff': the law Spring has no stiffness; leave it out",
        ),
    ],
)
def test_bad_input_is_named(robot: Robot, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        problem(robot, **changes)


@pytest.mark.parametrize(
    ("name", "given", "says"),
    [
        ("robot", "standin", "robot must be a Robot, not 'standin'"),
        ("stance", "both", "stance must be a Stance, not 'both'"),
        ("swing", (0.4, 0.8), r"swing must be a Phase, not \(0.4, 0.8\)"),
        ("follow", None, "follow must be a Phase, not None"),
    ],
)
def test_parts_of_another_type_are_refused(robot: Robot, name: str, given: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        dataclasses.replace(problem(robot), **{name: given})


def test_a_problem_does_not_follow_what_it_was_made_from(robot: Robot) -> None:
    duration, mass = np.array([0.0, 0.1]), np.array(5.0)
    made = problem(robot, contact_duration=duration, target=FreeMass(mass=mass))
    duration[1], mass[()] = 0.05, -1.0
    assert made.contact_duration == (0.0, 0.1)
    assert made.target == FreeMass(mass=5.0) and hash(made.target) == hash(FreeMass(mass=5.0))


def test_a_start_with_a_bad_configuration_is_named(robot: Robot) -> None:
    q = robot.posture("half_sitting")
    bad = q.copy()
    bad[9] = np.nan
    with pytest.raises(InputError, match=r"start posture.*nan.*index 9"):
        problem(robot, start=bad)
    with pytest.raises(InputError, match=r"start posture.*shape \(22\)"):
        problem(robot, start=q[:-1])
    bad = q.copy()
    bad[3:7] *= 2
    with pytest.raises(InputError, match=r"start posture.*quaternion.*norm 2"):
        problem(robot, start=bad)


def test_a_start_outside_its_limits_is_named(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"start posture.*'elbow' at 2.5 \(limits -2.2 to 2.2\)"):
        problem(robot, start=posture(robot, elbow=2.5))


def test_a_start_with_soles_off_the_ground_is_named(robot: Robot) -> None:
    high = robot.posture("half_sitting")
    high[2] += 0.01
    with pytest.raises(InputError, match="sole 'left' is 10 mm above the ground"):
        problem(robot, start=high)
    with pytest.raises(InputError, match=r"sole 'right' is tilted by 0\.1 rad"):
        problem(robot, start=posture(robot, right_ankle_roll=0.1))
    lifted = on_left(robot)
    with pytest.raises(InputError, match="sole 'right'"):
        problem(robot, start=lifted)
    # a foot that is not held may be in the air
    assert problem(robot, start=lifted, stance=OneSole("left")).coordinates.nl == 6


def test_a_robot_without_soles_or_free_flyer_is_named(robot: Robot) -> None:
    with pytest.raises(InputError, match="fixed base"):
        problem(arm(), striker="hand", start="start")
    with pytest.raises(InputError, match="no soles"):
        problem(dataclasses.replace(robot, soles=()))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: FreeMass(mass=-1.0), "mass"),
        (lambda: FreeMass(mass=np.nan), "mass"),
        (lambda: SpringDamper(stiffness=-1.0, damping=1.0), "stiffness"),
        (lambda: SpringDamper(stiffness=1.0, damping=-1.0), "damping"),
        (lambda: Phase(duration=0.0), "duration"),
        (lambda: Phase(duration=-0.5), "duration"),
        (lambda: Phase(duration=np.nan), "duration"),
        (lambda: Phase(duration=np.inf), "duration"),
        (lambda: Phase(duration=(0.8, 0.5)), "duration"),
        (lambda: Phase(duration=800), "0.001 to 60.* not 800; is it in milliseconds"),
        (lambda: Phase(duration=(0.5, 900)), "is it in milliseconds"),
        (lambda: Scenario(name="missing", missing=True, abort_after=25), r"abort_after \[s\]: 25; .*<= 10"),
        (lambda: Phase(duration=(0.5, 0.6, 0.7)), "duration"),
        (lambda: Phase(duration=0.8, intervals=5), "6 to 2000 spline intervals.*not 5"),
        (lambda: Phase(duration=0.8, intervals=7.5), "intervals"),
        (lambda: Phase(duration=0.8, grading=0.5), "grading"),
        (lambda: Phase(duration=0.8, grading=np.nan), "grading"),
        (lambda: Balance(capture_margin=np.inf), "capture_margin is inf.*give None for anywhere"),
        (lambda: Balance(capture_margin=-0.1), "Balance.capture_margin.*negative.*-0.1"),
        (lambda: Balance(vertical_speed=np.nan), "Balance.vertical_speed"),
        (lambda: Scenario(name=" "), "name is ' '.*give a word"),
        (lambda: Scenario(name=3), "name is 3"),  # type: ignore[arg-type]
        (lambda: Scenario(name="a", mass=np.nan), "scenario 'a': mass: nan; give a finite number"),
        (lambda: Scenario(name="a", cone_margin=np.inf), r"scenario 'a': cone_margin \[m\]: inf"),
        (lambda: Scenario(name="a", damping=-1.0), "scenario 'a': damping: -1; give.*>= 0"),
        (lambda: Scenario(name="a", capture_margin=-0.01), r"scenario 'a': capture_margin \[m\]: -0.01"),
        (lambda: Scenario(name="a", mass=0.0), "scenario 'a': mass: 0; give a number > 0"),
        (lambda: Scenario(name="a", stiffness=0.0), "scenario 'a': stiffness: 0; give a number > 0"),
        (lambda: Scenario(name="a", torque=0.0), "scenario 'a': torque: 0; give a number > 0"),
        (lambda: Scenario(name="a", missing=True, mass=2.0), "missing there is no collision; drop mass"),
        (lambda: Scenario(name="a", missing=True, torque=0.9), "missing there is no collision; drop torque"),
    ],
)
def test_bad_parts_are_named(make: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        make()


def test_a_misspelt_field_fails_when_it_is_written(robot: Robot) -> None:
    with pytest.raises(TypeError, match="strikr"):
        problem(robot, strikr="fist")
    with pytest.raises(dataclasses.FrozenInstanceError):
        problem(robot).point = np.zeros(3)  # type: ignore[misc]


# ---- phases and terms


def test_a_phase_of_one_duration_is_of_exactly_that_duration() -> None:
    assert Phase(duration=0.8).duration == (0.8, 0.8)
    assert Phase(duration=[0.5, 1]).duration == (0.5, 1.0)


@pytest.mark.parametrize("kind", [type(t) for t in DEFAULT_TERMS])
def test_no_term_takes_negative_numbers(kind: type[Term]) -> None:
    names = [f.name for f in dataclasses.fields(kind)]
    assert names
    for name in names:
        for bad in (-0.1, np.nan):
            with pytest.raises(InputError, match=f"{kind.__name__}.{name}"):
                kind(**{name: bad})


def test_terms_of_a_problem_come_before_the_defaults(robot: Robot) -> None:
    p = problem(robot, terms=(TorqueLimit(fraction=0.5),))
    assert p.term(TorqueLimit).fraction == 0.5
    for term in DEFAULT_TERMS[1:]:
        assert p.term(type(term)) == term


def test_every_term_has_a_name_and_a_unit() -> None:
    kinds = {TorqueLimit, VelocityLimit, PositionLimit, ContactWrenchCone, Balance, Incidence, LegExtension}
    assert {type(t) for t in DEFAULT_TERMS} == kinds | {SelfCollision, KeepOut, GroundForce, FirstTouch}
    assert len({t.name for t in DEFAULT_TERMS}) == len(DEFAULT_TERMS)
    assert all(t.name and t.unit for t in DEFAULT_TERMS)


# ---- solve


def test_an_unknown_solver_is_named_before_anything_is_built(robot: Robot) -> None:
    with pytest.raises(InputError, match=r"unknown solver 'ipot'.*did you mean 'ipopt'"):
        solve(problem(robot), solver="ipot")


# ---- scenarios and models of the collision


def test_scenarios_and_the_collision_are_described(robot: Robot) -> None:
    assert not {"scenarios", "collision"} & problem(robot).describe().keys()
    scenarios = [
        Scenario(name="soft", stiffness=0.5, damping=0.0),
        Scenario(name="gone", missing=True, capture_margin=0.05),
        Scenario(name="strict", torque=0.7),
    ]
    p = problem(robot, scenarios=scenarios)
    assert p.scenarios == tuple(scenarios)
    wanted = ["soft: 0.5 x stiffness, 0 x damping", "gone: no target", "strict: as expected"]
    assert p.describe()["scenarios"] == wanted
    json.dumps(p.describe())
    rigid = problem(robot, collision="rigid", coefficient_of_restitution=0.25)
    assert rigid.describe()["collision"] == "rigid, restitution 0.25"
    assert problem(robot, collision="virtual-mass").describe()["collision"] == "virtual-mass"


def test_balance_may_ask_for_nothing() -> None:
    term = Balance(capture_margin=None, vertical_speed=np.inf, angular_momentum=np.inf)
    assert term.capture_margin is None
