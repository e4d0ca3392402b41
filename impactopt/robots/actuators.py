"""`Actuator`: a joint's motor and gear, as far as it is known; which joints a class of them is of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import Described, about, abouts
from impactopt.errors import FARTHEST, InputError, check_choice
from impactopt.robots.checks import HEAVIEST, STRONGEST

__all__ = ["MOMENTARY_PEAK", "Actuator", "fitting", "known", "numbers_of", "with_classes"]

# of a gear over the joint's torque limit, where nothing better is known: see docs/howto/gears.md
MOMENTARY_PEAK = 2.0
# what a robot's file may say of a joint, whose motor is not known: nothing is 0
_OF_JOINT = ("viscous_friction", "coulomb_friction", "spring_stiffness", "spring_rest")
FASTEST, LATEST = 1e6, 1.0  # [Hz], [s] of a motor: beyond, it is none, or in other units


@dataclass(frozen=True, kw_only=True)
class Actuator(Described):
    """A joint's motor and gear, and a spring beside them. All is as the joint feels it, after the gear; None
    is not known.
    """

    armature: float | None = field(
        default=None,
        metadata=about(
            "reflected rotor inertia",
            unit="kg m2",
            least=0,
            most=HEAVIEST,
        ),
    )
    viscous_friction: float | None = field(
        default=None,
        metadata=about(
            "viscous friction of motor and gear",
            unit="N m s/rad",
            least=0,
            most=STRONGEST,
        ),
    )
    coulomb_friction: float | None = field(
        default=None,
        metadata=about(
            "Coulomb friction of motor and gear",
            unit="N m",
            least=0,
            most=STRONGEST,
        ),
    )
    spring_stiffness: float | None = field(
        default=None,
        metadata=about(
            "stiffness of a spring between the joint's links, beside the motor",
            unit="N m/rad",
            least=0,
            most=STRONGEST,
        ),
    )
    spring_rest: float | None = field(
        default=None,
        metadata=about("angle at which this spring is relaxed", unit="rad", least=-FARTHEST, most=FARTHEST),
    )
    continuous_torque: float | None = field(
        default=None,
        metadata=about("the gear's continuous torque", unit="N m", above=0, most=STRONGEST),
    )
    peak_torque: float | None = field(
        default=None,
        metadata=about("the gear's torque at each start and stop", unit="N m", above=0, most=STRONGEST),
    )
    momentary_torque: float | None = field(
        default=None,
        metadata=about("the gear's torque now and then, in an impact", unit="N m", above=0, most=STRONGEST),
    )
    stall_torque: float | None = field(
        default=None,
        metadata=about(
            "torque of the motor at rest",
            unit="N m",
            above=0,
            most=STRONGEST,
        ),
    )
    no_load_speed: float | None = field(
        default=None,
        metadata=about(
            "speed of the motor without torque",
            unit="rad/s",
            above=0,
            most=STRONGEST,
        ),
    )
    power_limit: float | None = field(
        default=None, metadata=about("mechanical power of the motor", unit="W", above=0, most=STRONGEST)
    )
    bandwidth: float | None = field(
        default=None,
        metadata=about(
            "bandwidth of the motor's torque, a lag of first order; left out: no lag",
            unit="Hz",
            above=0,
            most=FASTEST,
        ),
    )
    delay: float | None = field(
        default=None,
        metadata=about("delay from reading the joint to setting its torque", unit="s", least=0, most=LATEST),
    )

    def __post_init__(self) -> None:
        for told_of, told in abouts(type(self)):
            value = getattr(self, told_of.name)
            if value is None:
                continue
            number = told.checked(f"Actuator: {told_of.name} [{told.unit}]", value)
            object.__setattr__(self, told_of.name, number)
        if (self.stall_torque is None) != (self.no_load_speed is None):
            raise InputError(
                "Actuator: stall_torque and no_load_speed are two ends of one line; give both, or neither"
            )
        gear = ("continuous_torque", "peak_torque", "momentary_torque")
        known = [(name, value) for name in gear if (value := getattr(self, name)) is not None]
        for (low, less), (high, more) in pairwise(known):
            if less > more:
                raise InputError(
                    f"Actuator: {low} is {less:g} N m, and {high} {more:g} N m; a gear bears a larger torque "
                    "the more rarely it comes"
                )


def with_classes(
    classes: Mapping[str, Actuator], joints: Sequence[str], known: Sequence[Actuator], model: Any
) -> tuple[Actuator, ...]:
    """The actuator of each joint: of the last class whose name or pattern it fits, else the known one.

    classes : by names of joints, or patterns of them such as ``arm_*_4_joint``.
    model : a pin.Model with these joints last, which gets the armature of the classes.

    Raises
    ------
    InputError : what fits no joint.
    """
    out, base = list(known), model.nv - len(joints)
    for pattern, actuator in classes.items():
        if not isinstance(actuator, Actuator):
            raise InputError(f"actuators: of {pattern!r} is {actuator!r}; give an Actuator")
        for k in fitting(pattern, joints, "actuators"):
            own = {name: getattr(out[k], name) for name in _OF_JOINT if getattr(actuator, name) is None}
            out[k] = replace(actuator, armature=None, **own)
            if actuator.armature is not None:
                model.armature[base + k] = actuator.armature
    return tuple(out)


def known(actuators: Iterable[Actuator]) -> tuple[Actuator, ...]:
    """The actuators of a robot: without friction and springs where nothing is said of them."""
    return tuple(
        replace(actuator, **{name: 0.0 for name in _OF_JOINT if getattr(actuator, name) is None})
        for actuator in actuators
    )


def fitting(pattern: str, joints: Sequence[str], where: str) -> list[int]:
    """Places of the joints that a name or pattern fits; InputError, which begins with ``where``, if none."""
    fits = [k for k, joint in enumerate(joints) if joint == pattern or fnmatchcase(joint, pattern)]
    if not fits:
        check_choice(f"{where}: no joint is called", pattern, joints)
    return fits


def numbers_of(actuators: Iterable[Actuator], name: str) -> NDArray[np.float64]:
    """(n,) of one field of them; nan where it is not known."""
    values = [getattr(actuator, name) for actuator in actuators]
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
