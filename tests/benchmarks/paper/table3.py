"""Table III: two point masses, in the paper's setting.

A point of the virtual mass m_a meets the target of 5 kg; Runge-Kutta steps of 1e-4 s. No robot is in it, so
nothing is left to guess: the impulses are the paper's to the printed digit, peak forces within half a per
cent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from benchmarks.paper.paper import LAW, MOTIONS, STEP, TABLE_3, TARGET
from benchmarks.report import Report, Say, columns_table
from impactopt.collision import VirtualMass
from impactopt.robots.robot import Robot, Striker

COLUMNS = (
    ("motion", "motion", 0),
    ("m_a kg", "m_a_kg", 1),
    ("v_c m/s", "v_c_m_s", 1),
    ("f_max N", "f_max_N", 1),
    ("paper", "f_max_paper_N", 1),
    ("off %", "f_max_error_pct", 2),
    ("f_n N s", "impulse_Ns", 3),
    ("paper", "impulse_paper_Ns", 1),
    ("equal", "impulse_equal", 0),
)


def run(say: Say) -> Report:
    """The nine collisions."""
    rows: list[dict[str, Any]] = []
    for name, motion in MOTIONS.items():
        say(f"{name}: {motion.mass:g} kg at {motion.speed:g} m/s")
        printed = TABLE_3[name]
        model = VirtualMass(
            robot=point_mass(motion.mass),
            striker="tip",
            normal=[1.0, 0.0, 0.0],
            law=LAW,
            target=TARGET,
            method="rk4",
            step=STEP,
            horizon=0.1,
        )
        found = model.collide([0.0], [motion.speed])
        rows.append(
            {
                "motion": name,
                "m_a_kg": motion.mass,
                "v_c_m_s": motion.speed,
                "f_max_N": found.peak_force,
                "f_max_paper_N": printed.f_max,
                "f_max_error_pct": 100 * (found.peak_force / printed.f_max - 1),
                "impulse_Ns": found.impulse,
                "impulse_paper_Ns": printed.impulse,
                "impulse_error_Ns": found.impulse - printed.impulse,
                "impulse_equal": round(found.impulse, 1) == printed.impulse,
            }
        )
    numbers: dict[str, Any] = {
        "rows": rows,
        "impulses_equal": sum(row["impulse_equal"] for row in rows),
        "f_max_worst_error_pct": max(abs(row["f_max_error_pct"]) for row in rows),
    }
    title = "Table III: the virtual mass, ours and the paper's (equal: at its printed 0.1 N s)"
    table = columns_table(title, COLUMNS, rows)
    return Report(name="table3", numbers=numbers, tables=(table,))


def point_mass(mass: float) -> Robot:
    """A point mass [kg] free along x, without servo; its striker is `tip`."""
    model = pin.Model()
    model.name = "point mass"
    joint = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "rail")
    model.addJointFrame(joint)
    model.appendBodyToJoint(joint, pin.Inertia.FromSphere(mass, 0.05), pin.SE3.Identity())
    return Robot.from_model(
        model,
        kp=0.0,
        kd=0.0,
        torque_limit=1e4,
        velocity_limit=10.0,
        position_limit={"rail": (-5.0, 5.0)},
        strikers=[Striker(name="tip", frame="rail", point=np.zeros(3))],
    )
