"""The collisions and models of the bench of fidelity.

On each robot 27 collisions: three postures, the paper's three speeds, and half, once and twice the robot's
own servo gains, with the feed-forward torque that holds the robot's velocities.

The postures have effective masses of 1.4, 1.6 and 2 times the target's. A hand that is not heavier than the
target is held back by it, and the servo then pushes the target a second time, or past the horizon: such a
push ends, or not, by a hair, and its impulse jumps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any

from benchmarks.cases import PAPER_SPEEDS, Case, paper_motions
from impactopt.collision import SDC, CollisionModel, VirtualMass
from impactopt.contact import FreeMass, SpringDamper
from impactopt.robots.presets import load_robot
from impactopt.simulation.reference import FullDynamics, MujocoDynamics

# [kg] the paper's target, and for G1 (33 kg, light arms) a smaller one
TARGETS = {"standin": 5.0, "talos": 5.0, "g1": 1.5}
MASS_RATIOS = (1.4, 1.6, 2.0)  # effective mass over target's
GAINS = (0.5, 1.0, 2.0)  # times the robot's own kp and kd
FREEZES = (0, 1, 2, 4, 8, 16)
LAW = SpringDamper(stiffness=1e4, damping=300.0)  # the paper's
STRIKER, NORMAL = "right_hand", (1.0, 0.0, 0.0)
HORIZON = 0.2  # [s]
STEP = 1e-4  # [s] between instants of the reference


@dataclass(frozen=True, kw_only=True)
class Fidelity:
    """A model of the hierarchy by name; freezes only of "sdc"."""

    model: str
    freezes: int | None = None

    @property
    def label(self) -> str:
        return self.model if self.freezes is None else f"{self.model}, {self.freezes} freezes"

    def make(self, robot: str) -> CollisionModel:
        """Of the robot of that name, with its target."""
        options: dict[str, Any] = {
            "robot": situations(robot)[0].robot,
            "striker": STRIKER,
            "normal": NORMAL,
            "law": LAW,
            "target": FreeMass(mass=TARGETS[robot]),
            "horizon": HORIZON,
        }
        if self.model == "reference":
            return FullDynamics(**options, step=STEP)
        if self.model == "mujoco":
            return MujocoDynamics(**options)
        if self.model == "virtual-mass":
            return VirtualMass(**options)
        if self.model == "sdc-paper":
            return SDC.paper(**options)
        return SDC(**options, freezes=self.freezes or 0, accuracy=None)


HIERARCHY = (
    Fidelity(model="virtual-mass"),
    Fidelity(model="sdc-paper"),
    *(Fidelity(model="sdc", freezes=n) for n in FREEZES),
)


@cache
def situations(robot: str) -> tuple[Case, ...]:
    """The robot's 27 collisions: by posture, then speed, then gains."""
    built, target = load_robot(robot), TARGETS[robot]
    motions = paper_motions(
        built,
        striker=STRIKER,
        normal=NORMAL,
        masses={f"{ratio:g}": ratio * target for ratio in MASS_RATIOS},
        speeds=PAPER_SPEEDS,
    )
    return tuple(
        replace(
            motion,
            name=f"{motion.effective_mass:.3g} kg, {motion.speed:g} m/s, {gain:g} x gains",
            overrides={"kp": gain * built.kp, "kd": gain * built.kd},
        )
        for motion, gain in product(motions, GAINS)
    )
