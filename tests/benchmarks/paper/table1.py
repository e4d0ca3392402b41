"""Table I: the nine motions, as postures and velocities of our robots.

The paper gives masses and speeds and shows the postures in a picture; ours are those nearest to half-sitting
that have these masses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.cases import Case
from benchmarks.paper.motions import ROBOTS, WHOSE, motions
from benchmarks.paper.paper import MOTIONS
from benchmarks.report import Report, Say, columns_table

COLUMNS = (
    ("motion", "motion", 0),
    ("m_a kg", "m_a_kg", 4),
    ("paper", "m_a_paper_kg", 1),
    ("v_c m/s", "v_c_m_s", 2),
    ("paper", "v_c_paper_m_s", 1),
    ("hand x m", "hand_x_m", 3),
    ("hand z m", "hand_z_m", 3),
    ("speed", "joint_speed_ratio", 2),
    ("torque", "torque_ratio", 2),
)


def run(say: Say, *, robots: Sequence[str] = ROBOTS) -> Report:
    """The nine motions of each robot."""
    rows, tables = [], []
    for robot, cases in motions(robots, say):
        own = [row(robot, case) for case in cases]
        rows += own
        title = f"Table I on {robot}, {WHOSE[robot]} (speed, torque: of joints, over limit)"
        tables.append(columns_table(title, COLUMNS, own))
    return Report(name="table1", numbers={"rows": rows}, tables=tables)


def row(name: str, case: Case) -> dict[str, Any]:
    """Mass and speed, measured on the posture and the velocity, and where the robot is."""
    robot, paper = case.robot, MOTIONS[case.name]
    model, data = robot.model, robot.model.createData()
    pin.forwardKinematics(model, data, case.q, case.v)
    frame = model.getFrameId(robot.striker(case.striker).model_frame)
    hand = pin.updateFramePlacement(model, data, frame).translation
    speed = pin.getFrameVelocity(model, data, frame, pin.LOCAL_WORLD_ALIGNED).linear
    com = pin.centerOfMass(model, data, case.q)
    n = robot.n
    return {
        "robot": name,
        "motion": case.name,
        "m_a_kg": case.effective_mass,
        "m_a_paper_kg": paper.mass,
        "m_a_error_kg": case.effective_mass - paper.mass,
        "v_c_m_s": float(case.normal @ speed),
        "v_c_paper_m_s": paper.speed,
        "v_c_error_m_s": float(case.normal @ speed) - paper.speed,
        **{f"hand_{axis}_m": float(x) for axis, x in zip("xyz", hand, strict=True)},
        "com_x_mm": 1e3 * float(com[0]),
        "com_y_mm": 1e3 * float(com[1]),
        "joint_speed_ratio": float(np.max(np.abs(case.v[-n:]) / robot.velocity_limit)),
        "torque_ratio": float(np.max(np.abs(case.torque) / robot.torque_limit)),
        "joints_rad": dict(zip(robot.joint_names, robot.joint_positions(case.q).tolist(), strict=True)),
    }
