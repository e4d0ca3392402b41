"""Objectives of a plan: quantities whose weighted sum is maximized, the impulse by default. Motion styles:
prices on the motion that keep plans smooth and near the start posture.

A weight converts a quantity's unit to N s, so that objectives compare: with TargetEnergy(weight=0.5) beside
Impulse(), one more joule in the target counts as half a newton second. A new objective is a class here, and
is listed at the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.arrays import Array
from impactopt.contact.fields import Described, about
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets.base import Target
from impactopt.errors import MOST, InputError, check_array
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import check_known, kind_of

WEIGHT = about("value of one unit", unit="N s", key="weight")


@dataclass(frozen=True, kw_only=True)
class Objective(Described):
    """Base of all objectives. ``name`` stands in reports; ``unit`` is that of the quantity.

    An objective has :meth:`quantity`, and :meth:`blocks` if the quantity is not linear. ``whole_motion`` and
    ``needs_torques`` are as in :class:`impactopt.problem.terms.Term`.

    The weight is not zero; that of a cost is positive, as a price.
    """

    name: ClassVar[str] = ""
    unit: ClassVar[str] = ""
    cost: ClassVar[bool] = False  # less of it is better
    contact: ClassVar[bool] = False  # it is a quantity of a contact that lasts
    whole_motion: ClassVar[bool] = False
    needs_torques: ClassVar[bool] = False
    weight: float = field(metadata=WEIGHT)

    def __post_init__(self) -> None:
        kind = type(self).__name__
        if not check_array(f"{kind}.weight", self.weight, (), most=MOST):
            raise InputError(f"{kind}.weight is {self.weight}; give a number, or leave {kind} out")
        if self.cost and self.weight < 0:
            raise InputError(
                f"{kind}.weight is {self.weight:g}; give a number > 0, the price: {kind} is kept small"
            )

    def blocks(self, problem: Any, coordinates: Any) -> Mapping[str, Any]:
        """Nonlinear functions that the quantity needs, by name: `impactopt.problem.block.make_block`."""
        return {}

    def quantity(self, program: Any) -> Any:
        """The quantity, before its weight: an affine expression of a program's variables, or with their
        squares a :class:`impactopt.transcription.objective.Quantity`, as by `program.squares`.

        program : under construction, :class:`impactopt.transcription.contact_program.ContactProgram`.
        """
        raise NotImplementedError

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        """InputError if a problem does not have the quantity.

        turns : the compression ends once in the impact.  balance : the robot stands on soles.
        """


def check_objectives(
    objectives: object, *, contact: bool, turns: bool, balance: bool
) -> tuple[Objective, ...]:
    """Objectives as a tuple, checked.

    contact : the contact has a duration.  turns, balance : as of `Objective.check_fits`.

    Raises
    ------
    InputError : no objectives, other objects, two of a kind or name, a quantity that the problem does not
        have, or a user's own objective without `quantity` or name.
    """
    if not isinstance(objectives, (list, tuple)) or not all(isinstance(o, Objective) for o in objectives):
        raise InputError(
            f"objectives must be a tuple of objectives, such as (Impulse(),), not {objectives!r}"
        )
    if not objectives:
        raise InputError("objectives is empty: give what the plan is for, such as (Impulse(),)")
    check_known(objectives, Objective, "quantity")
    kinds, names = [kind_of(o, Objective) for o in objectives], [o.name for o in objectives]
    for o, kind in zip(objectives, kinds, strict=True):
        if kinds.count(kind) > 1:
            raise InputError(f"two objectives of kind {kind.__name__}: give one")
        if names.count(o.name) > 1:
            raise InputError(f"two objectives are called {o.name!r}: give {type(o).__name__} another name")
        if o.contact and not contact:
            raise InputError(
                f'{kind.__name__} is of a contact that lasts: give collision="full", or leave it out'
            )
        o.check_fits(turns=turns, balance=balance)
    return tuple(objectives)


@dataclass(frozen=True, kw_only=True)
class Impulse(Objective):
    """The impulse to the target."""

    name: ClassVar[str] = "impulse"
    unit: ClassVar[str] = "N s"
    weight: float = field(default=1.0, metadata=WEIGHT)

    def quantity(self, program: Any) -> Any:
        return program.expected.impulse


@dataclass(frozen=True, kw_only=True)
class Penetration(Objective):
    """The deepest penetration; a weight below zero keeps it small.

    In m, at the end of compression.
    """

    name: ClassVar[str] = "penetration"
    unit: ClassVar[str] = "m"
    contact: ClassVar[bool] = True
    weight: float = field(default=1000.0, metadata=WEIGHT)

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        if not turns:
            raise InputError("Penetration has no peak in the blow on a nail: take PeakForce or TargetEnergy")

    def quantity(self, program: Any) -> Any:
        return program.deepest_penetration()


@dataclass(frozen=True, kw_only=True)
class AngularMomentum(Objective):
    """Cost: angular momentum after contact, squared.

    |angular momentum|^2 about the centre of mass [(N m s)^2]. It is for robots that stand on soles.
    """

    name: ClassVar[str] = "angular momentum after contact, squared"
    unit: ClassVar[str] = "(N m s)^2"
    cost: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def check_fits(self, *, turns: bool, balance: bool) -> None:
        if not balance:
            raise InputError("AngularMomentum is of a robot that stands: leave it out on a fixed base")

    def quantity(self, program: Any) -> Any:
        return program.squares(program.angular_momentum)


PEAK_SCALE = 100.0  # [N] by which peak forces are scaled


@dataclass(frozen=True, kw_only=True)
class PeakForce(Objective):
    """The largest contact force; a weight below zero keeps it small.

    In N, of the forces at first touch and at collocation points, as the smooth maximum sum f^9 / sum f^8
    (Lehmer mean). This is at most the largest force, and equal to it if the others are zero or as large; for
    a half sine it is some 2 % less. With a damped law and several touches, the jumps at the later ones are
    not among these forces.
    """

    name: ClassVar[str] = "smooth peak force"
    unit: ClassVar[str] = "N"
    contact: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        striker, law = problem.striker, problem.law
        return {
            "peak": BlockRecipe(partial(peak, coordinates, striker, law), law.formula(), of_stages=True),
        }

    def quantity(self, program: Any) -> Any:
        return program.peak_force()


def peak(c: StanceCoordinates, striker: str, law: ContactLaw, stages: int) -> BlockExpression:
    """Lehmer mean of the contact forces, a smooth maximum.

    z = y, y', T at contact; f [N] at each stage.
    p = normal (3,); parameters of the law; the target's speed before [m/s].
    out = peak / 100 N.
    """
    y, y1, T, f = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T"), ca.SX.sym("f", stages)
    normal, of_law, before = ca.SX.sym("n", 3), ca.SX.sym("law", len(law.parameters)), ca.SX.sym("before")
    zero = ca.SX.zeros(c.ny)
    _, velocity, _ = striker_kinematics(c, striker)(*c.upper_motion(y, y1 / T, zero))
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    # a damped law has a force as soon as bodies touch; collocation points begin later
    first = law.branch(0.0, ca.dot(normal, velocity) - before, True, named)
    g = ca.vertcat(first, f) / PEAK_SCALE
    # with an even power the divisor is positive, though iterates may have negative forces
    out = ca.sum1(g**9) / (ca.sum1(g**8) + 1e-12)
    return make_block([y, y1, T, f], [normal, of_law, before], {"peak": out}, lanes=2)


@dataclass(frozen=True, kw_only=True)
class TargetEnergy(Objective):
    """The energy that the target has absorbed at separation, with the work done in it.

    In J: ``Target.energy``. A board with damping is refused, as its energy lacks the work of that.
    """

    name: ClassVar[str] = "target energy"
    unit: ClassVar[str] = "J"
    weight: float = field(default=1.0, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        return {"energy": BlockRecipe(lambda: energy(problem.target), problem.target.formula())}

    def quantity(self, program: Any) -> Any:
        return program.target_energy()


def energy(target: Target) -> BlockExpression:
    """Energy that the target holds or has absorbed.  z = its state;  p = its parameters;  out = energy
    [J].
    """
    state, numbers = ca.SX.sym("state", target.n_states), ca.SX.sym("numbers", len(target.parameters))
    named = {name: numbers[i] for i, name in enumerate(target.parameters)}
    return make_block([state], [numbers], {"energy": ca.SX(target.energy(state, named))}, lanes=2)


@dataclass(frozen=True, kw_only=True)
class Effort(Objective):
    """Cost: integral of (torque / limit)^2 over swing and follow-through, summed over joints.

    In s, by the trapezoidal rule on the nodes; stance phases before and after them are not counted. It is
    meant as a secondary objective with a small weight.
    """

    name: ClassVar[str] = "effort"
    unit: ClassVar[str] = "s"
    cost: ClassVar[bool] = True
    whole_motion: ClassVar[bool] = True
    needs_torques: ClassVar[bool] = True
    weight: float = field(default=0.01, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        return {"effort": BlockRecipe(lambda: effort(coordinates.robot.n))}

    def quantity(self, program: Any) -> Any:
        """Trapezoidal sum of T sum(tau^2), which is a lifted variable at each node."""
        swing, follow = program.torque_profiles()[:2]
        # from rest the torque at the start is constant; after a stance phase it is a variable
        known = int(not swing.torques[0].cols.size)
        slots = [[tau, swing.T] for tau in swing.torques[known:]] + [
            [tau, follow.T] for tau in follow.torques
        ]
        at = program.add_block("effort", slots, np.zeros(0))
        places = [*map(swing.place_at, swing.nodes[known:]), *map(follow.place_at, follow.nodes)]
        # by these names a program with more nodes maps the variables
        labels = [place.name for place in places]
        of_node = program.lift("effort of a node", at + np.arange(len(slots)), labels=labels)[0]
        of_swing = trapezoid(swing.nodes)
        weights = np.array([*of_swing[known:], *trapezoid(follow.nodes)])
        at_start = known * of_swing[0] * float(np.sum(swing.torques[0].const ** 2))
        return of_node.apply(weights[None]) + swing.T * at_start


def effort(n: int) -> BlockExpression:
    """Integrand of the effort.

    z = torques over limits (n), T [s];  out = T x sum of their squares [s].
    """
    torque, T = ca.SX.sym("torque", n), ca.SX.sym("T")
    return make_block([torque, T], [], {"effort": T * ca.sumsqr(torque)})


def trapezoid(nodes: Array) -> Array:
    """Weights (k,) of the trapezoidal rule on ascending nodes (k,)."""
    half = np.diff(nodes) / 2
    return np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])


@dataclass(frozen=True, kw_only=True)
class MotionPrices:
    """Prices of a whole motion. All but ``end`` are on the integral of a square over swing and
    follow-through.

    acceleration [N s per (rad/s^2)^2 s], jerk [N s per (rad/s^3)^2 s] : of all independent coordinates.
    speed, idle_speed [N s per (rad/s)^2 s] : of all independent coordinates, and of idle joints in addition.
    end [N s per rad^2] : on the squared distance of the end posture from the start posture.
    """

    acceleration: float = 0.0
    jerk: float = 0.0
    speed: float = 0.0
    idle_speed: float = 0.0
    end: float = 0.0

    def scaled(self, factor: float) -> MotionPrices:
        """All prices multiplied by a factor."""
        return replace(self, **{name: factor * value for name, value in vars(self).items()})


# Chosen for `punch` (figures: docs/howto/natural.md). The price on jerk removes reversals and peaks, that on
# idle speed the motion of limbs that do not contribute, that on speed the detours of all others.
STYLES: dict[str, MotionPrices] = {
    "natural": MotionPrices(jerk=7e-7, speed=7.5e-3, idle_speed=8e-2, end=2.0),
    "strongest": MotionPrices(),
}
DEFAULT_OBJECTIVES: tuple[Objective, ...] = (Impulse(),)
# all objectives of problem files, in their order
OBJECTIVES: tuple[type[Objective], ...] = (
    Impulse,
    PeakForce,
    TargetEnergy,
    Penetration,
    AngularMomentum,
    Effort,
)
