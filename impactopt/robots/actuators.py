"""`Actuator`: the known parameters of a joint's motor, gear and spring; their assignment to joints."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.contact.fields import Described, abouts, described
from impactopt.errors import FARTHEST, InputError, check_choice
from impactopt.robots.checks import HEAVIEST, STRONGEST

# Momentary peak torque of a gear over the joint's torque limit, if its data sheet is not known: our choice
# after Harmonic Drive's CSF-17-50, 34 N m repeated and 70 N m momentary peak (docs/howto/gears.md).
MOMENTARY_PEAK = 2.0
# Fields that a robot's file has without a motor's data; those that it leaves out are 0.
_FIELDS_OF_JOINT = ("viscous_friction", "coulomb_friction", "spring_stiffness", "spring_rest")
MAX_BANDWIDTH, MAX_DELAY = 1e6, 1.0  # [Hz], [s]: larger ones are mistakes, such as another unit


def _optional(what: str, unit: str, **limits: float) -> Any:
    """A field that is None if it is not known."""
    return described(None, what, unit=unit, **limits)


_NOT_NEGATIVE, _POSITIVE = {"least": 0, "most": STRONGEST}, {"above": 0, "most": STRONGEST}


@dataclass(frozen=True, kw_only=True)
class Actuator(Described):
    """A joint's motor and gear, and a spring in parallel to them. Values are at the joint, after the gear;
    None: not known.
    """

    armature: float | None = _optional("reflected rotor inertia", "kg m2", least=0, most=HEAVIEST)
    viscous_friction: float | None = _optional(
        "viscous friction of motor and gear", "N m s/rad", **_NOT_NEGATIVE
    )
    coulomb_friction: float | None = _optional("Coulomb friction of motor and gear", "N m", **_NOT_NEGATIVE)
    spring_stiffness: float | None = _optional(
        "stiffness of a spring between the joint's links, in parallel to the motor",
        "N m/rad",
        **_NOT_NEGATIVE,
    )
    spring_rest: float | None = _optional(
        "angle at which this spring is relaxed", "rad", least=-FARTHEST, most=FARTHEST
    )
    continuous_torque: float | None = _optional("the gear's continuous torque", "N m", **_POSITIVE)
    peak_torque: float | None = _optional("the gear's repeated peak torque", "N m", **_POSITIVE)
    momentary_torque: float | None = _optional(
        "the gear's momentary peak torque, as in an impact", "N m", **_POSITIVE
    )
    stall_torque: float | None = _optional("torque of the motor at rest", "N m", **_POSITIVE)
    no_load_speed: float | None = _optional("speed of the motor without torque", "rad/s", **_POSITIVE)
    power_limit: float | None = _optional("mechanical power of the motor", "W", **_POSITIVE)
    bandwidth: float | None = _optional(
        "bandwidth of the motor's torque, a lag of first order; left out: no lag",
        "Hz",
        above=0,
        most=MAX_BANDWIDTH,
    )
    delay: float | None = _optional(
        "delay from reading the joint to setting its torque", "s", least=0, most=MAX_DELAY
    )

    def __post_init__(self) -> None:
        for field_, description in abouts(type(self)):
            value = getattr(self, field_.name)
            if value is None:
                continue
            number = description.checked(f"Actuator: {field_.name} [{description.unit}]", value)
            object.__setattr__(self, field_.name, number)
        if (self.stall_torque is None) != (self.no_load_speed is None):
            raise InputError(
                "Actuator: stall_torque and no_load_speed are two ends of one line; give both, or neither"
            )
        gear = ("continuous_torque", "peak_torque", "momentary_torque")
        known = [(name, value) for name in gear if (value := getattr(self, name)) is not None]
        for (frequent, torque), (rare, peak) in pairwise(known):
            if torque > peak:
                raise InputError(
                    f"Actuator: {frequent} is {torque:g} N m, and {rare} {peak:g} N m; the rated torque of a "
                    "gear is larger, the more rarely it occurs: check the two numbers"
                )


def with_classes(
    classes: Mapping[str, Actuator], joints: Sequence[str], known: Sequence[Actuator], model: Any
) -> tuple[Actuator, ...]:
    """The actuator of each joint: that of the last class that matches its name, else the known one.

    classes : by names of joints, or patterns such as ``arm_*_4_joint``.
    model : a pin.Model with these joints last. Its armature is set to that of the classes, in place.

    Raises
    ------
    InputError : a name or pattern that matches no joint.
    """
    out, base = list(known), model.nv - len(joints)
    for pattern, actuator in classes.items():
        if not isinstance(actuator, Actuator):
            raise InputError(f"actuators: of {pattern!r} is {actuator!r}; give an Actuator")
        for k in fitting(pattern, joints, "actuators"):
            # a class without friction or springs leaves those of the robot's file
            own = {
                name: getattr(out[k], name) for name in _FIELDS_OF_JOINT if getattr(actuator, name) is None
            }
            out[k] = replace(actuator, armature=None, **own)
            if actuator.armature is not None:
                model.armature[base + k] = actuator.armature
    return tuple(out)


def known(actuators: Iterable[Actuator]) -> tuple[Actuator, ...]:
    """The actuators, with friction and springs that are not known set to zero."""
    out = []
    for actuator in actuators:
        missing = {name: 0.0 for name in _FIELDS_OF_JOINT if getattr(actuator, name) is None}
        out.append(replace(actuator, **missing) if missing else actuator)
    return tuple(out)


def fitting(pattern: str, joints: Sequence[str], where: str) -> list[int]:
    """Indices of the joints that a name or pattern matches; InputError, beginning with ``where``, if none."""
    fits = [k for k, joint in enumerate(joints) if joint == pattern or fnmatchcase(joint, pattern)]
    if not fits:
        check_choice(f"{where}: no joint is called", pattern, joints)
    return fits


def numbers_of(actuators: Iterable[Actuator], name: str) -> NDArray[np.float64]:
    """(n,) values of the field `name`; nan where it is not known."""
    values = [getattr(actuator, name) for actuator in actuators]
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
