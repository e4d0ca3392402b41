"""The collision of two masses as histories, for many numbers at once: what a log is fitted with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.collision.sdc import VirtualMass
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass
from impactopt.robots.robot import Robot, Striker

__all__ = ["HEAVIEST_HAND", "Course", "Lump"]

Array = NDArray[np.float64]
_HEAVY = 1e6  # [kg] of the side that stands for all the rest
HEAVIEST_HAND = 1e5  # [kg]
_INSTANTS = 1500  # of a history, over its horizon
_TOLERANCE = 1e-10  # tight, as derivatives are differences of these collisions


@lru_cache(maxsize=1)
def _heavy_hand() -> Robot:
    """A mass on a slide."""
    model = pin.Model()
    model.name = "heavy_hand"
    model.addBodyFrame("base", 0, pin.SE3.Identity(), 0)
    bounds = [np.array([x]) for x in (1e3, 1e3, -1e3, 1e3)]  # torque, speed, lower, upper
    slide = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide", *bounds)
    model.addJointFrame(slide, model.getFrameId("base"))
    model.appendBodyToJoint(slide, pin.Inertia.FromSphere(_HEAVY, 0.1), pin.SE3.Identity())
    striker = Striker(name="hand", frame="slide", point=np.zeros(3))
    return Robot.from_model(model, name="heavy_hand", strikers=(striker,))


@dataclass(frozen=True)
class Course:
    """One collision at its instants (k,): time [s] since the touch, force [N] and its slope [N/s], impulse so
    far [N s], and how far impulses have carried by then [N s2]: the integral of impulse."""

    time: Array
    force: Array
    slope: Array
    impulse: Array
    carried: Array

    def force_at(self, t: Array) -> Array:
        """[N] at times [s] since the touch; zero before and after the contact."""
        return np.interp(t, self.time, self.force, left=0.0, right=0.0)

    def slope_at(self, t: Array) -> Array:
        """[N/s]"""
        return np.interp(t, self.time, self.slope, left=0.0, right=0.0)

    def impulse_at(self, t: Array) -> Array:
        """[N s]"""
        return np.interp(t, self.time, self.impulse)

    def carried_at(self, t: Array) -> Array:
        """[N s2]; impulses go on to carry after the contact."""
        return np.interp(t, self.time, self.carried) + self.impulse[-1] * np.maximum(t - self.time[-1], 0.0)


class Lump:
    """`VirtualMass` under one contact law, with all its numbers, the mass and the speed as inputs.

    The relative motion of two free masses is that of their reduced mass against something that stays, or
    that goes on at its speed. So what varies is the mass of the *struck* side, an input of the compiled
    collision, and a hand of 1000 t goes on.

    Parameters
    ----------
    law : whose numbers are replaced.
    longest : [s] that a contact may last.
    """

    def __init__(self, law: ContactLaw, longest: float) -> None:
        # by powers of two, so that few lengths are ever compiled
        horizon = 2.0 ** np.ceil(np.log2(longest))
        self.law = law
        self._model = VirtualMass(
            robot=_heavy_hand(),
            striker="hand",
            normal=np.array([1.0, 0.0, 0.0]),
            law=law,
            target=FreeMass(mass=1.0),
            horizon=horizon,
            step=horizon / _INSTANTS,
            tolerance=_TOLERANCE,
        )

    def courses(self, numbers: Mapping[str, Array], mass: Array, speed: Array) -> list[Course]:
        """Collisions of N cases.

        numbers : of the law, (N,) each.  mass : (N,) [kg], reduced, up to `HEAVIEST_HAND`.  speed : (N,)
        [m/s] of approach.
        """
        struck = 1.0 / (1.0 / mass - 1.0 / _HEAVY)
        settings: dict[str, Any] = {f"contact_{name}": values for name, values in numbers.items()}
        found = self._model.batch(
            np.zeros((len(speed), 1)),
            speed[:, None],
            outputs=("time", "force", "target_speed", "duration"),
            threads=1,
            target_mass=struck,
            **settings,
        )
        rows = zip(found["time"], found["force"], struck[:, None] * found["target_speed"], strict=True)
        return [_course(*row) for row in rows]


def _course(time: Array, force: Array, impulse: Array) -> Course:
    if not np.isfinite(time).all():  # a collision that there is not, such as one without any force
        none = np.zeros(2)
        return Course(np.array([0.0, 1e-9]), none, none, none, none)
    last = int(np.searchsorted(time, time[-1])) + 1  # the last instant is repeated
    t, f, J = time[:last], force[:last], impulse[:last]
    steps = np.diff(t, prepend=0.0)
    carried = np.cumsum(steps * (J + np.concatenate([J[:1], J[:-1]])) / 2)
    return Course(t, f, np.gradient(f, t) if last > 1 else 0.0 * f, J, carried)
