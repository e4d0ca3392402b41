"""Effects of a collision model, and its settings: parameters that its functions take as inputs.

One of them is the reference of the servo during contact, which coasts with the soles in place, as a plan's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array
from impactopt.contact import ContactFriction, ContactLaw, Target
from impactopt.errors import (
    MOST,
    InputError,
    check_array,
    check_choice,
    check_direction,
    check_kind,
    check_positive,
    raw_array,
)
from impactopt.kinematics.coordinates import StanceCoordinates, independent_rates
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True)
class Effects:
    """Effects that a collision model takes into account, besides the servo's damping (paper, eq. 11).

    Attributes
    ----------
    stiffness : servo stiffness Kp (phi_ref - phi) (eq. 10); the reference continues at the joint velocity at
        contact, or follows the setting `reference`.
    feedforward : a feed-forward torque, an input of the functions, inside the saturation.
    saturation : the torque limits (eq. 12).
    friction : joint friction F (eqs. 5, 6), see `JointFriction`.
    bias : Coriolis, centrifugal and gravity terms c + g (eqs. 5, 6), frozen at contact.
    jdot : the Jacobians' rates times velocity (eq. 14), of hand and fixed soles, frozen at contact.
    """

    stiffness: bool = True
    feedforward: bool = True
    saturation: bool = True
    friction: bool = False
    bias: bool = True
    jdot: bool = True

    @classmethod
    def paper(cls, *, friction: bool = False) -> Effects:
        """Effects of the paper: damping and saturation, and friction if it is known."""
        return cls(
            stiffness=False, feedforward=False, saturation=True, friction=friction, bias=False, jdot=False
        )

    @classmethod
    def none(cls) -> Effects:
        """Nothing but the servo's damping."""
        return cls(stiffness=False, feedforward=False, saturation=False, bias=False, jdot=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class JointFriction:
    """Joint friction F = viscous phidot + coulomb sign(phidot); the sign is linear for |phidot| < transition.

    Attributes
    ----------
    viscous : (n,) or one number for all joints, >= 0 [N m s/rad].
    coulomb : (n,) or one number for all joints, >= 0 [N m].
    transition : [rad/s] > 0. Within this band Coulomb friction is a damping coulomb / transition [N m s/rad],
        which limits the step length (see `SDC.stable_step`); a joint does not stick, it creeps.
    """

    viscous: ArrayLike = 0.0
    coulomb: ArrayLike = 0.0
    transition: float = 0.01

    def __post_init__(self) -> None:
        for name in ("viscous", "coulomb"):
            value: Any = getattr(self, name)
            shape = (None,) * min(raw_array(f"JointFriction: {name}", value).ndim, 1)
            number = check_array(f"JointFriction: {name}", value, shape, most=MOST)
            if (number < 0).any():
                raise InputError(f"JointFriction: {name} must be >= 0")
        check_positive("JointFriction: transition [rad/s]", self.transition, most=MOST)

    def arrays(self, n: int) -> tuple[Array, Array]:
        """Coefficients (viscous, coulomb), each (n,)."""
        out = []
        for name in ("viscous", "coulomb"):
            value = np.asarray(getattr(self, name), dtype=float)
            value = np.full(n, float(value)) if value.ndim == 0 else value
            out.append(check_array(f"JointFriction: {name} (one a joint)", value, (n,)))
        return out[0], out[1]


# permitted signs of the servo's settings
_SIGN = {
    "friction_stiffness": "> 0",
    "kp": ">= 0",
    "kd": ">= 0",
    "torque_limit": "> 0",
    "viscous": ">= 0",
    "coulomb": ">= 0",
    "reference_until": "> 0",
}


_NEVER = 1e6  # [s] later than the end of any collision
# highest power of time in the joint velocities of the servo's reference
REFERENCE_ORDER = 10


# [N m] in the place of infinite torque limits, as 0 x infinity is NaN
NO_LIMIT = 1e12


class Settings(Mapping[str, Array]):
    """Parameters of a collision with their default values, by input name, in the order of the inputs.

    There are only those that the model's effects need: normal (3); contact_<parameter of the law>;
    target_<parameter of the target>; with friction at the striking point friction_coefficient,
    friction_slip_speed [m/s] and, of bristles, friction_stiffness [N/m]; and with a servo
    (`servo_settings`) kd; kp with servo stiffness; torque_limit (n) with saturation; viscous, coulomb (n)
    with friction. kp and kd are (n), or (n, n) if the model was given matrices.

    With dJ/dt v, and without friction, there are reference (n, 10) [rad/s^(k + 1)], coefficients of t^k in
    column k - 1 of the change of the joint velocities of the servo's reference, and reference_until [s],
    after which these are constant. Without them the reference keeps the joint velocities at contact.
    """

    def __init__(
        self,
        law: ContactLaw,
        target: Target,
        normal: ArrayLike,
        servo: Mapping[str, ArrayLike],
        friction: ContactFriction | None = None,
    ) -> None:
        check_kind("law", law, ContactLaw)
        check_kind("target", target, Target)
        self._owners: dict[str, tuple[type, dict[str, float]]] = {
            "contact_": (type(law), law.parameters),
            "target_": (type(target), target.parameters),
        }
        if friction is not None:
            names = asdict(friction)  # in the order of `parameters`, whose last one only bristles have
            self._owners["friction_"] = (ContactFriction, dict(zip(names, friction.parameters, strict=False)))
        values: dict[str, Any] = {"normal": normal}
        for prefix, (_, parameters) in self._owners.items():
            values |= {prefix + key: number for key, number in parameters.items()}
        values |= servo
        self._values = {name: np.asarray(value, dtype=float) for name, value in values.items()}
        self._values = {name: self._check(name, value) for name, value in self._values.items()}

    def override(self, changes: Mapping[str, ArrayLike]) -> dict[str, Array]:
        """All values, with some of them changed; a single number for a setting of the joints applies to all.

        Raises
        ------
        InputError : an unknown name, a wrong shape, NaN, a sign, or a normal that is not a unit vector.
        """
        for name in changes:
            check_choice("no setting", name, self._values)
        return {
            name: self._check(name, changes[name]) if name in changes else v
            for name, v in self._values.items()
        }

    def _check(self, name: str, value: ArrayLike) -> Array:
        if name == "normal":
            return check_direction(name, value)
        shape = self._values[name].shape
        if len(shape) == 1 and raw_array(name, value).ndim == 0:
            value = np.full(shape, check_array(name, value, (), finite=name != "torque_limit"))
        array = check_array(name, value, shape, finite=name != "torque_limit")
        if name == "torque_limit":
            array = np.minimum(array, NO_LIMIT)
        if name in ("kp", "kd") and array.ndim == 2:
            # a servo must not add energy
            # x' K x depends on the symmetric part alone
            least = float(np.linalg.eigvalsh((array + array.T) / 2).min())
            if least < -1e-9 * np.abs(array).max():
                raise InputError(f"{name}: not positive semidefinite, it has the eigenvalue {least:.3g}")
            return array
        sign = _SIGN.get(name, "")
        if (sign and (array < 0).any()) or (sign == "> 0" and (array == 0).any()):
            raise InputError(f"{name}: has {array.min():g}; all must be {sign}")
        for prefix, (owner, parameters) in self._owners.items():
            if name.startswith(prefix):
                # the constructor checks the ranges of law, target and friction
                owner(**{**parameters, name.removeprefix(prefix): float(array)})
        return array

    def __getitem__(self, name: str) -> Array:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)


def servo_settings(
    robot: Robot,
    effects: Effects,
    friction: JointFriction,
    kp: ArrayLike | None = None,
    kd: ArrayLike | None = None,
) -> dict[str, ArrayLike]:
    """Settings of the joints that these effects need.

    kp, kd : one number for all joints, (n), or (n, n); None: the robot's.
    """
    values: dict[str, ArrayLike] = {"kd": _gain("kd", kd, robot.kd)}
    if effects.stiffness:
        values["kp"] = _gain("kp", kp, robot.kp)
    if effects.saturation:
        values["torque_limit"] = robot.torque_limit
    if effects.friction:
        values["viscous"], values["coulomb"] = friction.arrays(robot.n)
    elif effects.jdot:
        # Joint velocities of a reference change because of dJ/dt v. The model's velocities are then relative
        # to the reference, but friction needs absolute ones.
        values |= constant_reference(robot.n)
    return values


def constant_reference(n: int) -> dict[str, Array]:
    """Settings `reference` (n, 10) and `reference_until` that keep the joint velocities at contact."""
    return {"reference": np.zeros((n, REFERENCE_ORDER)), "reference_until": np.array(_NEVER)}


def _gain(name: str, given: ArrayLike | None, own: Array) -> Array:
    if given is None:
        return own
    n, ndim = own.size, raw_array(name, given).ndim
    if ndim == 0:
        return np.full(n, check_array(name, given, ()))
    return check_array(name, given, (n,) * min(ndim, 2))


_NODES = 3 * REFERENCE_ORDER  # of the fit
_MIN_TIME = 1e-3  # [s] below which legs that do not reach are an error
_SHRINK = 0.9  # of the fitted time, as long as the fit is not good
_MAX_ERROR = 1e-4  # [rad/s] of a good fit


def coasting_reference(
    coordinates: StanceCoordinates, q: ArrayLike, v: ArrayLike, *, until: float = 0.1
) -> dict[str, Array]:
    """Settings of a collision model in which the servo's reference keeps the soles in place.

    During contact a plan's reference keeps the rates ydot of its independent coordinates: the base's pose and
    the joints outside the legs. The soles stay in place, so that the velocities of the leg joints change.
    Their change is fitted by t, t^2, ... t^10. The fit is exact in the acceleration at contact. It covers the
    longest time between half of `until` and `until` for which its error is below 1e-4 rad/s: less for legs
    that are nearly straight, whose velocities grow without bound.

    Parameters
    ----------
    coordinates : of the stance, such as `ImpactProblem.coordinates`.
    q, v : (nq,), (nv,) at contact, Pinocchio's, with the soles in place and at rest.
    until : [s] since contact; twice the contact's duration is a good value.

    Returns
    -------
    reference (n, 10) [rad/s^(k + 1)], reference_until [s] : by name, as `collide` takes them.

    Raises
    ------
    InputError : wrong shapes or NaN; soles that are not in place; a time that is not positive.
    """
    check_kind("coordinates", coordinates, StanceCoordinates)
    c, robot = coordinates, coordinates.robot
    q, v = robot.check_configuration(q), robot.check_velocity(v)
    check_positive("until [s]", until)
    if not c.legs:
        return constant_reference(robot.n)
    y, legs = c.split(q)
    rates, shortest = independent_rates(c, y, v), until / 2
    _, start, acceleration = c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, legs))
    orders = np.arange(2, REFERENCE_ORDER + 1)
    while True:
        # least squares at Chebyshev nodes are nearly the best uniform fit
        times = until * (1 - np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)) / 2
        try:
            velocities = np.array([_velocity(c, y + rates * t, rates, legs) for t in times])
        except InputError:  # the legs do not reach that far
            if until < _MIN_TIME:
                raise
        else:
            # the linear term is known, so the fit begins with t^2
            remainder = (velocities - start - np.outer(times, acceleration))[:, -robot.n :]
            powers = (times / until)[:, None] ** orders
            fitted = np.linalg.lstsq(powers, remainder, rcond=None)[0]
            if np.abs(powers @ fitted - remainder).max() < _MAX_ERROR or until * _SHRINK < shortest:
                break
        until *= _SHRINK
    # fitted in t / until, so that powers up to the tenth are of order one
    reference = np.column_stack([acceleration[-robot.n :], fitted.T / until**orders])
    return {"reference": reference, "reference_until": np.array(until)}


def _velocity(c: StanceCoordinates, y: Array, rates: Array, legs: Array) -> Array:
    """v (nv,) at y (ny,) with rates (ny,); `legs` is the initial guess of the inverse kinematics."""
    return c.complete_motion(y, rates, np.zeros(c.ny), c.solve_legs(y, legs))[1]
