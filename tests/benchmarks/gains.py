"""From free joints to one rigid body: the impulse of the same blow with stiffer and stiffer servos.

Kp and Kd of all joints are scaled together. Without them a hand hits as its effective mass does; where they
are endless, robots that are held to the ground hit as a wall that moves. Nothing but servo and contact is in
these collisions, so both ends are known in closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.report import Report, Say, columns_table
from impactopt.collision import SDC, Effects, effective_mass
from impactopt.contact import FreeMass, SpringDamper
from impactopt.kinematics.operational_space import striking_velocity
from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot

# robot: its striker, and the posture that it hits from
BLOWS = {
    "planar_arm": ("hammer", "ready"),
    "arm7": ("hammer", "ready"),
    "standin": ("right_hand", "half_sitting"),
    "g1": ("right_hand", "half_sitting"),
}
QUICK = ("planar_arm", "arm7")
NORMALS = {"right_hand": (1.0, 0.0, 0.0), "hammer": (0.6, 0.0, -0.8)}
LAW, TARGET = SpringDamper(stiffness=1e5, damping=100.0), FreeMass(mass=1.0)  # a stiff blow of some ms
FACTORS = tuple(float(f) for f in 10.0 ** np.arange(-4, 8.1, 0.5))
ONLY_SERVO = Effects(bias=False, jdot=False, saturation=False, feedforward=False)
SHOWN = (1e-4, 0.1, 1.0, 10.0, 1e2, 1e4, 1e8)  # in the table
COLUMNS = (
    ("robot", "robot", 0),
    ("gains x", "factor", "g"),
    ("impulse N s", "impulse_Ns", 4),
    ("from free to locked", "share", 4),
    ("free N s", "free_Ns", 4),
    ("locked N s", "locked_Ns", 4),
)


def run(say: Say, *, quick: bool = False, robots: Sequence[str] = ()) -> Report:
    """One row a robot and a factor of its gains.  quick : two arms only, if no robots are named."""
    rows: list[dict[str, Any]] = []
    for name in robots or (QUICK if quick else BLOWS):
        say(name)
        rows += _rows(name, load_robot(name))
    shown = [row for row in rows if any(np.isclose(row["factor"], f) for f in SHOWN)]

    def picture() -> Any:
        from benchmarks.pictures.gains import gains_picture

        return gains_picture(rows)

    return Report(
        name="gains",
        numbers={"rows": rows},
        tables=(columns_table("impulse by the servo's gains, at 1 m/s", COLUMNS, shown),),
        figures={"gains": picture},
    )


def _rows(name: str, robot: Robot) -> list[dict[str, Any]]:
    striker, posture = BLOWS[name]
    normal, q = np.array(NORMALS[striker]), robot.posture(posture)
    v = striking_velocity(robot, q, striker, normal, 1.0)
    mass = float(effective_mass(robot, striker=striker, normal=normal)(q))
    free, locked = impulse_of(mass), impulse_of(np.inf)
    out = []
    for factor in FACTORS:
        model = SDC(
            robot=robot,
            striker=striker,
            normal=normal,
            law=LAW,
            target=TARGET,
            effects=ONLY_SERVO,
            kp=factor * robot.kp,
            kd=factor * robot.kd,
            accuracy=None,
        )
        impulse = float(model.collide(q, v).impulse)
        share = (impulse - free) / (locked - free)
        own = {"robot": name, "factor": factor, "impulse_Ns": impulse, "share": share}
        out.append({**own, "free_Ns": free, "locked_Ns": locked, "effective_mass_kg": mass})
    return out


def impulse_of(mass: float) -> float:
    """[N s] that a point mass [kg] of 1 m/s gives the target: damped in compression, not in restitution."""
    reduced = 1 / (1 / mass + 1 / TARGET.mass)
    z = LAW.damping / (2 * np.sqrt(LAW.stiffness * reduced))
    return float(reduced * (1 + np.exp(-z * np.arccos(z) / np.sqrt(1 - z**2))))
