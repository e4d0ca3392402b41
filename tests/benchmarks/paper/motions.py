"""The paper's nine motions through every model of the hierarchy, and full dynamics.

The paper's robot is HRP-2, whose description is not public, in OpenHRP3. Ours are a stand-in of HRP-2's class
(see `impactopt.robots.presets.standin`) and TALOS, in postures found by optimization, and the reference is
full dynamics on fixed soles: the paper's figures stand beside ours for comparison, not as a reference.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.cases import Case, paper_motions
from benchmarks.paper.paper import LAW, STEP, TARGET
from benchmarks.report import Say
from impactopt.collision import SDC, Collision, CollisionModel, VirtualMass
from impactopt.errors import InputError
from impactopt.robots.presets import load_robot
from impactopt.robots.robot import Robot
from impactopt.simulation.reference import FullDynamics

ROBOTS = ("standin", "talos")
WHOSE = {"standin": "a stand-in for the paper's HRP-2", "talos": "TALOS, which the paper has not"}
HORIZON = 0.4  # [s]; the longest of these contacts, TALOS A-2, takes 0.25 s
STRIKER, NORMAL = "right_hand", (1.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Fidelity:
    """A model of the hierarchy.

    model, freezes : what tables call it; None where freezes on the way are no matter.
    build : makes it for a robot.
    """

    model: str
    freezes: int | None
    build: Callable[[Robot], CollisionModel]


def setting(robot: Robot) -> dict[str, Any]:
    """What all models share: the paper's contact and target, at the right hand, along x."""
    return {
        "robot": robot,
        "striker": STRIKER,
        "normal": NORMAL,
        "law": LAW,
        "target": TARGET,
        "horizon": HORIZON,
    }


def _virtual_mass(robot: Robot) -> CollisionModel:
    return VirtualMass(**setting(robot), method="rk4", step=STEP)


def _sdc_paper(robot: Robot) -> CollisionModel:
    return SDC.paper(**setting(robot))


def _sdc(freezes: int) -> Callable[[Robot], CollisionModel]:
    return lambda robot: SDC(**setting(robot), freezes=freezes, accuracy=None)


HIERARCHY = (
    Fidelity(model="virtual-mass", freezes=None, build=_virtual_mass),
    Fidelity(model="sdc-paper", freezes=0, build=_sdc_paper),
    *(Fidelity(model="sdc", freezes=k, build=_sdc(k)) for k in (0, 1, 2, 4, 8)),
)


def motions(robots: Sequence[str], say: Say) -> Iterator[tuple[str, list[Case]]]:
    """(name, its nine motions) of each robot; one whose files are not installed is left out, and named.

    Raises
    ------
    InputError : none of the robots is there.
    """
    missing = []
    for name in robots:
        try:
            robot = load_robot(name)
        except InputError as error:
            missing.append(str(error))
            say(f"{name} is left out: {error}")
            continue
        say(f"{name}: looking for postures")
        yield name, paper_motions(robot, striker=STRIKER, normal=NORMAL)
    if missing and len(missing) == len(robots):
        raise InputError(missing[0])


def reference(case: Case, *, form: str = "lagrange") -> tuple[Collision, float]:
    """(the motion in full dynamics, what a tighter tolerance has changed in its impulse [N s])."""
    model = FullDynamics(**setting(case.robot), step=STEP, form=form)
    return model.converged(case.q, case.v, case.torque, require_separation=False)
