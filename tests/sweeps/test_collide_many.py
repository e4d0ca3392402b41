"""Collisions by the million: the same numbers as one by one, states that hold what they say, reasons."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from support.fake_solution import strike_record
from support.small_robots import arm, biped

from impactopt import (
    SDC,
    BothSoles,
    FixedBase,
    Free,
    FreeMass,
    InputError,
    KelvinVoigt,
    Nail,
    Robot,
    SpringDamper,
    collide_many,
    holding_torque,
    load_problem,
    load_robot,
    space_arm,
    striking_velocity,
)
from impactopt.collide.contact_states import ContactStates, Posture
from impactopt.collide.single_collision import collide_once, meets_again
from impactopt.files.output import save_record
from impactopt.files.problem_file import ProblemFile
from impactopt.files.sections.reading import CollisionFile
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.kinematics.stance import Stance, margin
from impactopt.report.console import collision_table
from impactopt.report.result_rows import collision_rows, contact_rows
from impactopt.sweeps import sweep_from_data
from impactopt.sweeps.collisions import Collisions

POINT, NORMAL = [0.7, 0.0, 0.75], np.array([0.0, 0.0, -1.0])


def arm_file(**problem: Any) -> ProblemFile:
    """A planar arm of three joints that strikes a mass downwards."""
    given = {"robot": "planar_arm", "striker": "hammer", "start": "ready", "point_m": POINT}
    data = {
        "problem": {**given, "normal": NORMAL.tolist(), **problem},
        "target": {"mass_kg": 0.5},
        "contact": {"stiffness_N_m": 2e4, "damping_N_s_m": 50.0},
    }
    return ProblemFile.from_data(data, Path("arm.toml"))


def standin_file() -> ProblemFile:
    data = {
        "problem": {
            "robot": "standin",
            "striker": "right_hand",
            "point_m": [0.4, -0.2, 0.9],
            "normal": [1.0, 0.0, 0.0],
        },
        "target": {"mass_kg": 5.0},
        "contact": {"stiffness_N_m": 1e4, "damping_N_s_m": 300.0},
    }
    return ProblemFile.from_data(data, Path("standin.toml"))


def drawn(count: int, **ranges: tuple[float, float]) -> dict[str, Any]:
    rng = np.random.default_rng(1)
    return {key.replace("__", "."): rng.uniform(*ends, count) for key, ends in ranges.items()}


# ---------------------------------------------------------------- the same numbers as one by one
def test_rows_are_single_collisions() -> None:
    columns = drawn(
        5,
        target__mass=(0.2, 2.0),
        contact__stiffness=(5e3, 5e4),
        contact__damping=(0.0, 100.0),
        at_contact__speed=(0.5, 1.5),
        at_contact__joints__elbow=(-0.2, 0.2),
        at_contact__kd_scale=(0.5, 2.0),
    )
    outputs = ("impulse_Ns", "peak_force_N", "contact_ms", "energy_J", "torque_ratio", "target_speed_m_s")
    found = collide_many(arm_file(), columns, outputs=outputs, at_contact={"posture": "ready"})
    robot = load_robot("planar_arm")
    for i, mass in enumerate(columns["target.mass"]):
        law = SpringDamper(stiffness=columns["contact.stiffness"][i], damping=columns["contact.damping"][i])
        q = robot.posture("ready")
        q[robot.joint_index("elbow")] += columns["at_contact.joints.elbow"][i]
        v = striking_velocity(robot, q, "hammer", NORMAL, columns["at_contact.speed"][i])
        one = SDC(
            robot=robot,
            striker="hammer",
            normal=NORMAL,
            law=law,
            target=FreeMass(mass=mass),
            kd=robot.kd * columns["at_contact.kd_scale"][i],
        ).collide(q, v, holding_torque(robot, q, v))
        assert found["reason"][i] == ""
        assert one.demand is not None
        expected = (
            one.impulse,
            one.peak_force,
            1e3 * one.duration,
            one.energy,
            np.abs(one.demand / robot.torque_limit).max(),
            one.target_result["speed"],
        )
        for name, value in zip(outputs, expected, strict=True):
            assert found[name][i] == pytest.approx(value, rel=1e-9), name
        # a balance that no model enters
        assert found["impulse_Ns"][i] == pytest.approx(mass * found["target_speed_m_s"][i], rel=1e-9)


@pytest.mark.slow
def test_of_a_robot_on_soles_with_its_margins() -> None:
    columns = drawn(
        3, target__mass=(3.0, 8.0), at_contact__speed=(0.3, 1.0), at_contact__torque_limit_scale=(0.5, 1)
    )
    outputs = ("impulse_Ns", "zmp_margin_m", "sole_force_N", "torque_ratio", "effective_mass_kg")
    found = collide_many(standin_file(), columns, outputs=outputs, at_contact={"posture": "half_sitting"})
    robot = load_robot("standin")
    q = robot.posture("half_sitting")
    model = SDC(
        robot=robot,
        striker="right_hand",
        normal=[1.0, 0.0, 0.0],
        law=SpringDamper(stiffness=1e4, damping=300.0),
        target=FreeMass(mass=5.0),
    )
    whole = Collisions(standin_file(), {"posture": "half_sitting", "speed_m_s": 1.0}, outputs)
    polygon = whole._batch({}).posture()
    assert isinstance(polygon, Posture)
    for i, mass in enumerate(columns["target.mass"]):
        v = striking_velocity(robot, q, "right_hand", np.array([1.0, 0, 0]), columns["at_contact.speed"][i])
        limit = robot.torque_limit * columns["at_contact.torque_limit_scale"][i]
        one = model.collide(q, v, holding_torque(robot, q, v), target_mass=mass, torque_limit=limit)
        assert one.zmp is not None and one.sole_wrench is not None and one.demand is not None
        assert found["impulse_Ns"][i] == pytest.approx(one.impulse, rel=1e-9)
        assert found["zmp_margin_m"][i] == pytest.approx(margin(polygon.polygon, one.zmp).min(), rel=1e-7)
        assert found["sole_force_N"][i] == pytest.approx(one.sole_wrench[..., 2].min(), rel=1e-7)
        assert found["torque_ratio"][i] == pytest.approx(np.abs(one.demand / limit).max(), rel=1e-9)


@pytest.mark.slow
def test_loads_of_the_ground_in_a_contact_of_less_than_a_millisecond() -> None:
    """They are largest in the middle of the contact, as full dynamics have them."""
    outputs = ("zmp_margin_m", "sole_force_N", "torque_ratio")
    columns = {"contact.stiffness": [1e4, 1e6, 1e8, 1e8], "at_contact.speed": [0.5, 0.5, 0.25, 0.5]}
    given = {"posture": "half_sitting"}
    found = collide_many(standin_file(), columns, outputs=outputs, at_contact=given)
    full = collide_many(standin_file(), columns, outputs=outputs, at_contact={**given, "model": "full"})
    assert full["sole_force_N"][2] < 0 < full["sole_force_N"][1] and full["zmp_margin_m"][3] == -np.inf
    for name in outputs:
        assert found[name] == pytest.approx(full[name], rel=0.01, abs=1e-3 if name == "zmp_margin_m" else 2.0)
    section = {**standin_file().data["contact"], "stiffness_N_m": 1e8}
    stiff = ProblemFile.from_data({**standin_file().data, "contact": section}, Path("stiff.toml"))
    once = collide_once(stiff, {**given, "speed_m_s": 0.5})
    assert once["sole_force_N"] == pytest.approx(found["sole_force_N"][3], rel=1e-6)
    assert once["zmp_margin_m"] is None


def test_a_ground_without_load_is_in_the_table() -> None:
    rows = {row.label: row.cells[0] for row in collision_rows({"zmp_margin_m": None, "sole_force_N": -10.0})}
    assert rows["ZMP margin [mm]"].text == "-inf" and not rows["ZMP margin [mm]"].good
    assert "ZMP margin [mm]" not in {row.label for row in collision_rows({"impulse_Ns": 1.0})}


@pytest.mark.slow
def test_a_model_without_gravity_has_no_forces_on_single_soles() -> None:
    """The soles carry the weight however slow the hit is; the paper's model told of forces about zero."""
    given = {"posture": "half_sitting", "speed_m_s": 1e-3}
    paper = collide_once(standin_file(), {**given, "model": "sdc-paper"})
    assert "sole_force_N" not in paper and "zmp_margin_m" in paper
    assert "without those that carry the weight" in str(collision_table(paper).caption)
    assert collide_once(standin_file(), given)["sole_force_N"] > 100.0


@pytest.mark.parametrize(("stiffness", "again"), [(1e5, False), (1e7, True)])
def test_a_nail_that_is_touched_again_is_told(stiffness: float, again: bool) -> None:
    """Two point masses and the wood by SciPy: a nail that jumps ahead is driven on by later touches."""
    nail = {"kind": "nail", "mass_kg": 0.05, "resistance_N": 600.0}
    contact = {"law": "Kelvin-Voigt", "stiffness_N_m": stiffness, "damping_N_s_m": 20.0}
    data = {**arm_file().data, "target": nail, "contact": contact}
    given = {"posture": "ready", "speed_m_s": 3.0, "model": "virtual-mass"}
    found = collide_once(ProblemFile.from_data(data, Path("nail.toml")), given)

    def motion(_: float, y: Any) -> list[float]:
        hand, at, speed, moves = y
        touches = hand > at
        force = max(stiffness * (hand - at) + 20.0 * (speed - moves), 0.0) if touches else 0.0
        push = force - 600.0
        driven = push / 0.05 if moves > 0 or push > 0 else 0.0
        return [speed, max(moves, 0.0), -force / found["effective_mass_kg"], driven]

    later = solve_ivp(motion, (0.0, 0.02), [0.0, 0.0, 3.0, 0.0], method="LSODA", rtol=1e-7, max_step=1e-5)
    driven, first = float(later.y[1, -1]), found["target"]["depth_m"]
    assert ("again" in found) == again and ("again: " in str(collision_table(found).caption)) == again
    if again:
        assert driven > 2 * first
    else:
        assert driven == pytest.approx(first, rel=0.01)


def test_a_contact_that_has_not_ended_is_not_touched_again() -> None:
    """The live page shows such contacts; their striker still moves with the nail."""
    robot, nail = load_robot("planar_arm"), Nail(mass=0.05, resistance=600.0)
    q = robot.posture("ready")
    v = striking_velocity(robot, q, "hammer", NORMAL, 3.0)
    law = KelvinVoigt(stiffness=1e5, damping=20.0)
    model = SDC(robot=robot, striker="hammer", normal=NORMAL, law=law, target=nail, horizon=2e-3)
    found = model.collide(q, v, holding_torque(robot, q, v), require_separation=False)
    assert not found.separated and found.hand_speed[-1] > 1.0
    assert not meets_again(nail, found)


def test_a_floating_robot_that_has_momentum_is_told() -> None:
    """Without it, as from rest, the joints are faster."""
    problem = Path(__file__).resolve().parents[2] / "problems" / "space_arm.toml"
    file, given = CollisionFile.read(problem), {"posture": "ready", "speed_m_s": 0.5}
    found = collide_once(file, {**given, "model": "rigid"})
    robot, normal = space_arm(), np.array(file.content.problem.normal)
    q = robot.posture("ready")
    v = striking_velocity(robot, q, file.content.problem.striker, normal, 0.5, stance=Free())
    body = ConstrainedDynamics.at(robot.model, q, (), robot.striker(file.content.problem.striker).model_frame)
    inertia = body.inertia
    assert found["drifts"].startswith(
        f"the floating robot has a momentum of {np.linalg.norm((inertia @ v)[:3]):.3g} N s"
    )
    assert "drifts" not in collide_once(standin_file(), {"speed_m_s": 0.3, "model": "rigid"})
    # of least energy among those with the base's generalized momentum zero
    rows = np.vstack([inertia[:6], body.hand])
    needed = np.concatenate([np.zeros(6), 0.5 * normal])
    responses = np.linalg.solve(inertia, rows.T)
    from_rest = responses @ np.linalg.solve(rows @ responses, needed)
    assert np.abs(from_rest[6:] / robot.velocity_limit).max() > 2 * found["velocity_ratio"]


def test_the_table_has_two_digits_of_a_target_of_grams() -> None:
    """A gram that 0.5 m/s hit: rounded to a thousandth, its impulse was off by a third."""
    found = {"impulse_Ns": 7.46e-4, "energy_J": 2.79e-4, "peak_force_N": 0.0, "target": {"speed_m_s": 0.746}}
    rows = {row.label: row.cells[0].text for row in collision_rows(found)}
    assert float(rows["impulse [N s]"]) == pytest.approx(7.46e-4, rel=0.05)
    assert float(rows["energy to the target [J]"]) == pytest.approx(2.79e-4, rel=0.05)
    assert (rows["peak force [N]"], rows["speed of the target [m/s]"]) == ("0.0", "0.746")
    (planned,) = (row for row in contact_rows([found]) if row is not None and row.label == "impulse [N s]")
    assert planned.cells[0].text == "0.00075"


def test_columns_may_be_a_table_of_pandas() -> None:
    pandas = pytest.importorskip("pandas")
    columns = {"target.mass": [0.1, 0.2], "at_contact.speed": [0.5, 1.0]}
    found = collide_many(arm_file(), pandas.DataFrame(columns))["impulse_Ns"]
    np.testing.assert_array_equal(found, collide_many(arm_file(), columns)["impulse_Ns"])
    with pytest.raises(InputError, match="at_contact must be a Mapping"):
        collide_many(arm_file(), columns, at_contact=np.ones(3))


def test_structure_may_differ_from_row_to_row() -> None:
    models = ["sdc", "virtual-mass", "sdc-paper", "sdc"]
    columns = {"at_contact.model": models, "target.mass": [0.5, 0.5, 0.5, 2.0], "at_contact.speed": [1.0]}
    found = collide_many(arm_file(), columns)["impulse_Ns"]
    for i, name in enumerate(models):
        alone = {"model": name, "speed_m_s": 1.0}
        one = collide_many(arm_file(), {"target.mass": columns["target.mass"][i : i + 1]}, at_contact=alone)
        assert found[i] == one["impulse_Ns"][0]
    assert len({*found}) == 4


def test_freezes_come_near_the_full_dynamics() -> None:
    given = {"posture": "ready", "speed_m_s": 1.5, "horizon_s": 0.1}
    true = collide_many(arm_file(), {"at_contact.model": ["full"]}, at_contact=given)["impulse_Ns"]
    near = collide_many(arm_file(), {"at_contact.freezes": [2, 4, 8]}, at_contact=given)["impulse_Ns"]
    errors = np.abs(near / true - 1)
    assert all(two < one for one, two in pairwise(errors))
    assert errors[-1] < 1e-5


def test_friction_and_restitution_vary_too() -> None:
    """The hammer slides along the nail's head as it comes down: what holds it back makes it heavier."""
    columns = {"at_contact.speed": [1.0] * 3, "friction.coefficient": [0.1, 0.3, 0.9]}
    full, frozen = (
        collide_many(arm_file(), columns, at_contact={"velocity": "least rates", "model": model})
        for model in ("full", "sdc")
    )
    assert (full["reason"] == "").all() and (frozen["reason"] == "").all()
    assert (np.diff(full["impulse_Ns"]) > 0).all()
    np.testing.assert_allclose(frozen["impulse_Ns"], full["impulse_Ns"], rtol=1e-3)
    e = np.array([0.0, 0.5, 1.0])
    columns = {"at_contact.speed": [1.0] * 3, "collision.coefficient_of_restitution": e.tolist()}
    rigid = collide_many(arm_file(), columns, at_contact={"model": "rigid"}, outputs=("impulse_Ns",))
    np.testing.assert_allclose(rigid["impulse_Ns"], (1 + e) * rigid["impulse_Ns"][0], rtol=1e-9)


def test_a_contact_too_stiff_for_its_friction_has_a_model_that_takes_it() -> None:
    """It was told to give a step, which neither the command nor a file has."""
    data = {**arm_file().data, "friction": {"coefficient": 0.5}, "contact": {"stiffness_N_m": 1e7}}
    data["contact"]["damping_N_s_m"] = 50.0
    file, given = ProblemFile.from_data(data, Path("stiff.toml")), {"posture": "ready", "speed_m_s": 0.5}
    with pytest.raises(InputError, match=r"take FullDynamics \(\[at_contact\] model, or --model: 'full'\)"):
        collide_once(file, given)
    with pytest.raises(InputError, match=r"in every collision, as in the first, where .* take FullDynamics"):
        collide_many(file, {"contact.stiffness": [1e8]}, at_contact=given)
    assert collide_once(file, {**given, "model": "full"})["impulse_Ns"] > 0


def test_gains_and_limits_are_the_robots_of_the_file_with_them() -> None:
    """The default of Kp is 30 1/s times Kd."""
    robot, given = load_robot("planar_arm"), {"posture": "ready", "speed_m_s": 1.0}
    stiff, weak = float(2 * robot.kd[0]), float(0.5 * robot.torque_limit[0])
    columns = {"robot.kd": [stiff, robot.kd[0]], "robot.torque_limit.elbow": [weak, robot.torque_limit[0]]}
    outputs = ("impulse_Ns", "torque_ratio")
    found = collide_many(arm_file(), columns, outputs=outputs, at_contact=given)
    q = robot.posture("ready")
    v = striking_velocity(robot, q, "hammer", NORMAL, 1.0)
    law = SpringDamper(stiffness=2e4, damping=50.0)
    model = SDC(robot=robot, striker="hammer", normal=NORMAL, law=law, target=FreeMass(mass=0.5))
    for i, (kd, elbow) in enumerate(zip(*columns.values(), strict=True)):
        limit = robot.torque_limit.copy()
        limit[robot.joint_index("elbow")] = elbow
        damping = np.full(robot.n, kd)
        one = model.collide(
            q, v, holding_torque(robot, q, v), kd=damping, kp=30 * damping, torque_limit=limit
        )
        assert one.demand is not None
        assert found["impulse_Ns"][i] == pytest.approx(one.impulse, rel=1e-9)
        assert found["torque_ratio"][i] == pytest.approx(np.abs(one.demand / limit).max(), rel=1e-9)


def soft_grip_file() -> ProblemFile:
    """The arm with a mallet in a soft grip."""
    mallet = {"name": "mallet", "frame": "wrist", "mass_kg": 0.5, "center_m": [0.2, 0.0, 0.0]}
    mallet |= {"inertia_kg_m2": np.diag([1e-3] * 3).tolist(), "head_m": [0.25, 0.0, 0.0]}
    grip = {"axis": [0.0, 1.0, 0.0], "stiffness_N_m_rad": 10.0, "damping_N_m_s_rad": 0.3}
    soft = {"preset": "planar_arm", "tools": [mallet], "grips": {"mallet": grip}}
    data = {**arm_file().data, "robot": soft}
    data["problem"] = {k: x for k, x in data["problem"].items() if k != "robot"} | {"striker": "mallet"}
    return ProblemFile.from_data(data, Path("grip"))


def test_gains_of_all_joints_leave_a_soft_grip_as_it_is() -> None:
    given, file = {"posture": "ready", "speed_m_s": 1.0, "model": "full"}, soft_grip_file()
    alone = collide_many(file.changed({"robot.kp": 4000.0}), {}, at_contact=given)
    swept = collide_many(file, {"robot.kp": [4000.0]}, at_contact=given)
    assert swept["reason"][0] == "" and swept["impulse_Ns"] == alone["impulse_Ns"]


def test_scales_of_the_servo_leave_a_soft_grip_as_it_is() -> None:
    given, file = {"posture": "ready", "speed_m_s": 1.0, "model": "full"}, soft_grip_file()
    robot = load_robot("planar_arm")
    stiff = {f"robot.kp.{name}": 10 * float(kp) for name, kp in zip(robot.joint_names, robot.kp, strict=True)}
    stiff |= {f"robot.kd.{name}": 2 * float(kd) for name, kd in zip(robot.joint_names, robot.kd, strict=True)}
    alone = collide_many(file.changed(stiff), {}, at_contact=given)
    scales = {"kp_scale": 10.0, "kd_scale": 2.0}
    columns = {f"at_contact.{key}": [scale] for key, scale in scales.items()}
    swept = collide_many(file, columns, at_contact=given)
    assert swept["impulse_Ns"][0] == pytest.approx(alone["impulse_Ns"][0], rel=1e-6)
    once = collide_once(file, {**given, **scales})
    assert once["impulse_Ns"] == pytest.approx(alone["impulse_Ns"][0], rel=1e-6)
    as_it_is = collide_many(file, {}, at_contact=given)
    assert abs(alone["impulse_Ns"][0] / as_it_is["impulse_Ns"][0] - 1) > 1e-3


def test_a_robot_of_little_weight_has_a_zmp_too() -> None:
    """At rest it is below the centre of mass, whatever the robot weighs: here 0.6 N."""
    given = {"posture": "half_sitting", "speed_m_s": 1e-6}
    margins = []
    for gravity in (9.81, 0.01):
        section = {"preset": "standin", "gravity_m_s2": [0.0, 0.0, -gravity]}
        data = {**standin_file().data, "robot": section}
        data["problem"] = {key: x for key, x in data["problem"].items() if key != "robot"}
        file = ProblemFile.from_data(data, Path("light.toml"))
        margins.append(collide_many(file, {}, at_contact=given, outputs=("zmp_margin_m",))["zmp_margin_m"][0])
    assert margins[1] == pytest.approx(margins[0], abs=1e-3)


BOTH, LEFT, RIGHT = ({"soles": soles} for soles in (["left", "right"], ["left"], ["right"]))


def with_stance(sections: dict[str, Any], ahead: float = 0.4) -> ProblemFile:
    """The stand-in's file with other sections and a hit point `ahead` [m]."""
    data = {**standin_file().data, **sections}
    data["problem"] = {**data["problem"], "point_m": [ahead, -0.2, 0.9]}
    return ProblemFile.from_data(data, Path("standin.toml"))


@pytest.mark.slow
def test_a_robot_stands_as_in_the_phase_of_the_impact() -> None:
    outputs, given = ("impulse_Ns", "zmp_margin_m", "sole_force_N"), {"speed_m_s": 0.5}
    long = {"duration_s": 0.6}
    phases = with_stance({"stances": [BOTH | long, LEFT, BOTH | long]})
    found = collide_many(
        phases, {"stances.1.soles": [["left"], ["right"]]}, outputs=outputs, at_contact=given
    )
    for i, sole in enumerate(("left", "right")):
        one = collide_many(with_stance({"stance": {"soles": sole}}), {}, outputs=outputs, at_contact=given)
        assert all(found[name][i] == one[name][0] for name in outputs)
    once = collide_once(phases, given)
    assert once["sole_force_N"] == pytest.approx(found["sole_force_N"][0], rel=1e-6)


def test_a_robot_strikes_from_where_its_steps_lead() -> None:
    """Both feet step ahead by as much as the hit point is farther."""
    long, given = {"duration_s": 0.6}, {"speed_m_s": 0.5}
    left, right = ({"steps_m": {name: [0.15, 0.0]}} for name in ("left", "right"))
    stances = [BOTH | long, RIGHT | long, BOTH | long | left, LEFT | long, BOTH | right]
    stepped = collide_many(with_stance({"stances": stances}, 0.55), {}, at_contact=given)
    still = collide_many(with_stance({}), {}, at_contact=given)
    assert stepped["impulse_Ns"][0] == pytest.approx(still["impulse_Ns"][0], rel=1e-6)


def test_impossible_stance_phases_are_refused_for_a_collision_too() -> None:
    with pytest.raises(InputError, match="the impact is in one phase"):
        collide_many(with_stance({"stances": [BOTH, LEFT, BOTH]}), {}, at_contact={"speed_m_s": 0.5})
    with pytest.raises(InputError, match="no collision depends on it"):
        phases = with_stance({"stances": [BOTH | {"duration_s": 0.6}, LEFT]})
        collide_many(phases, {"stances.0.duration_s": [0.7]}, at_contact={"speed_m_s": 0.5})


# ---------------------------------------------------------------- states
@pytest.mark.parametrize("robot, stance", [(biped(5), BothSoles()), (space_arm(), Free())])
def test_states_have_torques_of_motors_only(robot: Robot, stance: Stance) -> None:
    """Compiled as in NumPy: none about hinges of soles, and those of a robot that floats freely."""
    (name, q), (striker, _) = next(iter(robot.postures.items())), next(iter(robot.strikers.items()))
    states = ContactStates(robot=robot, striker=striker, stance=stance, start=q, folder=Path())
    posture = states.posture(name, None, (0.0, 0.0, 0.0))
    assert isinstance(posture, Posture)
    found = states.compute(posture, {}, np.array([1.0]), np.array([1.0, 0.0, 0.0]), 1)
    expected = holding_torque(robot, found.q[0], found.v[0], stance=stance)
    assert np.abs(expected).max() > 0.1
    assert found.torque[0] == pytest.approx(expected, abs=1e-8)
    assert not found.torque[0, robot.hinges].any()


@pytest.mark.parametrize("velocity", ["least energy", "least rates"])
def test_states_move_the_striking_point_and_coast(velocity: str) -> None:
    robot, normal = biped(), np.array([0.8, 0.6, 0.0])
    states = ContactStates(
        robot=robot, striker="fist", stance=BothSoles(), start=robot.posture("half_sitting"), folder=Path()
    )
    posture = states.posture("half_sitting", None, (0.0, 0.0, 0.0))
    assert isinstance(posture, Posture)
    rng = np.random.default_rng(0)
    joints = {name: rng.uniform(-0.3, 0.3, 300) for name in ("elbow", "shoulder yaw")}
    speed = rng.uniform(0.1, 1.0, 300)
    found = states.compute(posture, joints, speed, normal, 300, velocity=velocity)
    for i in (0, 255, 299):  # in the first block of rows, and in what is left of the last
        q, v = found.q[i], found.v[i]
        data = robot.model.createData()
        pin.computeJointJacobians(robot.model, data, q)
        pin.updateFramePlacements(robot.model, data)
        frames = [s.frame for s in robot.soles]
        still = [robot.model.getFrameId(name) for name in frames]
        hand = robot.model.getFrameId("striker:fist")
        jac = {k: pin.getFrameJacobian(robot.model, data, k, pin.LOCAL_WORLD_ALIGNED) for k in (*still, hand)}
        assert jac[hand][:3] @ v == pytest.approx(speed[i] * normal, abs=1e-10)
        for k in still:
            assert jac[k] @ v == pytest.approx(np.zeros(6), abs=1e-10)
        assert found.torque[i] == pytest.approx(holding_torque(robot, q, v), abs=1e-8)
        energy = striking_velocity(robot, q, "fist", normal, speed[i])
        weight = np.concatenate([np.full(6, 1e-2), 1 / robot.velocity_limit])
        if velocity == "least energy":
            assert v == pytest.approx(energy, abs=1e-10)
        else:  # any other velocity with the same hand has faster joints
            assert np.linalg.norm(weight * v) < np.linalg.norm(weight * energy)
            rows = np.vstack([jac[k] for k in still] + [jac[hand][:3]])
            free = np.linalg.svd(rows)[2][np.linalg.matrix_rank(rows) :]
            assert free @ (weight**2 * v) == pytest.approx(np.zeros(len(free)), abs=1e-10)


def test_a_continuous_joint_turns() -> None:
    robot = arm()
    start = robot.posture("start")
    states = ContactStates(robot=robot, striker="hand", stance=FixedBase(), start=start, folder=Path())
    posture = states.posture("start", None, (0.0, 0.0, 0.0))
    assert isinstance(posture, Posture)
    found = states.compute(posture, {"turn": np.array([0.5, 3.0])}, np.ones(2), np.array([0.0, 1.0, 0.0]), 2)
    turned = [robot.joint_positions(q)[0] for q in found.q]
    assert turned == pytest.approx([0.9, 3.4 - 2 * np.pi])


def test_the_state_of_a_result(tmp_path: Path) -> None:
    robot = load_robot("planar_arm")
    q = robot.posture("ready")
    v = np.array([0.3, 1.0, 0.4])
    torque = holding_torque(robot, q, v) + 1.0
    save_record(strike_record(robot, q, v, torque), tmp_path)
    law = SpringDamper(stiffness=2e4, damping=50.0)
    model = SDC(robot=robot, striker="hammer", normal=NORMAL, law=law, target=FreeMass(mass=0.5))
    as_saved = collide_many(
        arm_file(), {}, at_contact={"result": str(tmp_path)}, outputs=("impulse_Ns", "hand_speed_m_s")
    )
    assert as_saved["impulse_Ns"][0] == pytest.approx(model.collide(q, v, torque).impulse, rel=1e-9)
    short = {"result": str(tmp_path), "freezes": 2, "horizon_s": 1e-3}
    assert "raise it: at_contact.horizon_s" in collide_once(arm_file(), short)["reason"]
    twice = {"at_contact.speed": [2 * as_saved["hand_speed_m_s"][0]]}
    faster = collide_many(arm_file(), twice, at_contact={"result": str(tmp_path)})
    other = torque + holding_torque(robot, q, 2 * v) - holding_torque(robot, q, v)
    assert faster["impulse_Ns"][0] == pytest.approx(model.collide(q, 2 * v, other).impulse, rel=1e-9)


def test_a_reach_hits_where_it_is_told() -> None:
    whole = Collisions(arm_file(), {"speed_m_s": 1.0}, ("impulse_Ns",))
    alike = whole._batch({})
    robot = alike.model.robot
    for point in ((0.7, 0.0, 0.75), (0.6, 0.0, 0.8)):
        posture = alike.posture(point)
        assert isinstance(posture, Posture)
        data = robot.model.createData()
        pin.framesForwardKinematics(robot.model, data, posture.q)
        at = data.oMf[robot.model.getFrameId("striker:hammer")].translation
        assert at == pytest.approx(np.array(point), abs=1e-7)
    columns = {"problem.point.2": [0.75, 0.8, 5.0], "problem.point.0": [0.7, 0.6, 0.6]}
    found = collide_many(arm_file(), columns, at_contact={"speed_m_s": 1.0})
    assert found["reason"].tolist() == ["", "", "the point is out of reach"]
    one = collide_many(arm_file(point_m=[0.6, 0.0, 0.8]), {}, at_contact={"speed_m_s": 1.0})
    assert found["impulse_Ns"][1] == pytest.approx(one["impulse_Ns"][0], rel=1e-12)


# ---------------------------------------------------------------- rows that are impossible, and mistakes
def test_what_is_impossible_says_why() -> None:
    columns = {"at_contact.joints.elbow": [0.0, 9.0, 0.0], "at_contact.speed": [1.0, 1.0, 500.0]}
    found = collide_many(arm_file(), columns, at_contact={"posture": "ready"})
    assert found["reason"][0] == ""
    assert found["reason"][1] == "elbow would be beyond its limit"
    assert "faster than its limit" in found["reason"][2]
    assert np.isnan(found["impulse_Ns"]).tolist() == [False, True, True]
    columns, slow = {"target.initial_velocity": [-1.0, 0.3, 0.5]}, {"posture": "ready", "speed_m_s": 0.4}
    found = collide_many(arm_file(), columns, at_contact=slow)
    fled = "the target moves away at least as fast as the striking point"
    assert found["reason"].tolist() == ["", "", fled], "it was an impulse of zero"
    assert np.isnan(found["impulse_Ns"]).tolist() == [False, False, True]
    assert collide_once(arm_file().changed({"target.initial_velocity": 0.5}), slow)["reason"] == fled
    short = {"posture": "ready", "speed_m_s": 1.0, "horizon_s": 2e-3}
    found = collide_many(arm_file(), {"target.mass": [0.5, 0.001]}, at_contact=short)
    assert "not ended" in found["reason"][0] and found["reason"][1] == ""


@pytest.mark.parametrize(
    ("columns", "at_contact", "says"),
    [
        ({"target.mas": [1.0]}, {}, "did you mean 'mass_kg'|did you mean 'mass'"),
        ({"at_contact.sped": [1.0]}, {}, "did you mean 'speed"),
        ({"at_contact.joints": [1.0]}, {}, "name one joint"),
        ({"at_contact.joints.elbo": [1.0]}, {}, "did you mean 'elbow'"),
        ({"swing.duration": [1.0]}, {}, "no collision depends on it"),
        ({"target.body.size": [[0.1, 0.1, 0.1]]}, {}, "no collision depends on it"),
        ({"target.body.shape": ["box", "ball"]}, {}, "no collision depends on it"),
        ({"target.mass": [1.0, -1.0]}, {}, "give a number > 0"),
        ({"target.mass": [1.0, "heavy"]}, {}, "mass_kg: 'heavy'; give a number"),
        ({"at_contact.kd_scale": [1.0, -1.0]}, {}, "give a number > 0"),
        ({"target.mass": [1.0, 2.0], "contact.damping": [1.0, 2.0, 3.0]}, {}, "columns 3"),
        ({"target.mass": [1.0], "target.mass_kg": [1.0]}, {}, "two columns are of one key"),
        ({}, {"posture": "redy"}, "did you mean 'ready'"),
        ({}, {"posture": "ready", "result": "there"}, "give one of them"),
        ({}, {"model": "virtual-mass", "freezes": 2}, "freezes"),
        (
            {"at_contact.freezes": [10**9]},
            {},
            "freezes: 1000000000; give a number .* 64",
        ),  # it took all memory
    ],
)
def test_mistakes_are_told_before_work_starts(
    columns: dict[str, Any], at_contact: dict[str, Any], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        collide_many(arm_file(), columns, at_contact={"speed_m_s": 1.0, **at_contact})


def test_a_problem_in_python_is_no_file() -> None:
    problem: Any = load_problem("arm_planar")
    with pytest.raises(InputError, match="this is of type ImpactProblem; `write_problem`"):
        collide_many(problem, {"target.mass": [1.0]})
    given = {"sweep": {"problem": problem, "case_kind": "strike"}, "grid": {"target.mass": [1.0]}}
    with pytest.raises(InputError, match="is of type ImpactProblem, which TOML does not have"):
        sweep_from_data(given)


def test_mistakes_in_what_is_asked_for() -> None:
    with pytest.raises(InputError, match="speed_m_s: missing"):
        collide_many(arm_file(), {})
    with pytest.raises(InputError, match="did you mean 'impulse_Ns'"):
        collide_many(arm_file(), {}, outputs=("impulse",), at_contact={"speed_m_s": 1.0})
    with pytest.raises(InputError, match="did you mean 'impulse_Ns'"):
        collide_many(arm_file(), {}, outputs="impulse", at_contact={"speed_m_s": 1.0})
    with pytest.raises(InputError, match="soles"):
        collide_many(arm_file(), {}, outputs=("zmp_margin_m",), at_contact={"speed_m_s": 1.0})
    for model, what in (("rigid", "a rigid impact"), ("virtual-mass", "a point mass")):
        with pytest.raises(InputError, match=f"output 'demand': {what} knows nothing of it"):
            given = {"speed_m_s": 1.0, "model": model}
            collide_many(arm_file(), {}, outputs=("torque_ratio",), at_contact=given)
    with pytest.raises(InputError, match="forces on single soles lack the weight"):
        given = {"speed_m_s": 1.0, "model": "sdc-paper"}
        collide_many(standin_file(), {}, outputs=("sole_force_N",), at_contact=given)
    with pytest.raises(InputError, match="which is held"):
        given = {"speed_m_s": 1.0, "joints_rad": {standin_leg(): 0.1}}
        collide_many(standin_file(), {}, at_contact=given)


def standin_leg() -> str:
    robot = load_robot("standin")
    return robot.joint_names[robot.limb(robot.soles[0].frame)[0]]
