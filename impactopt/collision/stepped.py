"""Base class of the stepped collision models, and linearity and derivatives of law and target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from impactopt.codegen.cache import model_hash
from impactopt.collision.interface import CollisionModel
from impactopt.collision.outputs import OF_SERVO, OF_SOLES, OUTPUTS
from impactopt.collision.settings import Effects, JointFriction, Settings
from impactopt.contact import ContactFriction, ContactLaw, Target
from impactopt.contact.friction import check_friction, moves_target
from impactopt.errors import InputError, check_array, check_choice, check_positive


def law_is_linear(law: ContactLaw) -> bool:
    """True if both branches are linear for all values of the law's parameters; a kink counts as nonlinear.

    So does a force that is cut below zero: one that is not zero where contact begins, or falls with the rate
    in compression.
    """
    parameters, branches = _law_parts(law)
    x = branches[0][1]
    start = [ca.substitute(f, x, ca.SX.zeros(2)) for f, _ in branches]
    parts = ca.vertcat(*start, *[ca.jacobian(f, x).T for f, _ in branches])
    found = [_sampled(parameters, law.parameters, parts, x, k) for k in range(_PARAMETER_SETS)]
    # Exactly equal: the slopes of a linear law are expressions without penetration and rate.
    linear = all((values == values[0]).all() and not values[:, :2].any() for values in found)
    return linear and all((values[:, -1] >= 0).all() for values in found)  # slope of compression by the rate


def target_is_linear(target: Target) -> bool:
    """True if rates, velocity and switches are linear between switches, for all values of the parameters."""
    parameters, (outputs, x) = _target_part(target)
    hessian = ca.jacobian(ca.vec(ca.jacobian(outputs, x)), x)
    if not hessian.nnz():
        return True
    found = [_sampled(parameters, target.parameters, hessian, x, k) for k in range(_PARAMETER_SETS)]
    return all((values == 0).all() for values in found)


# parameter sets for which linearity is tested: those of law or target themselves, and random ones
_PARAMETER_SETS = 3


def _sampled(parameters: Any, values: dict[str, float], f: Any, x: Any, seed: int) -> NDArray[np.float64]:
    """Values of f at 132 random points (rows) of all magnitudes.

    The parameters are `values` for seed 0, else random ones.
    """
    rng, function = np.random.default_rng(seed), ca.Function("f", [parameters, x], [ca.densify(ca.vec(f))])
    own = np.array(list(values.values()))
    # other parameters, as one that happens to be 0 or 1 may hide a nonlinear term
    given = own * rng.uniform(0.5, 2.0, own.size) + rng.uniform(0.1, 0.5, own.size) if seed else own
    # from micrometres to tens of kilonewtons, so that thresholds of either are crossed
    sizes = np.repeat(np.logspace(-6, 4, 11), 12)
    points = sizes * rng.uniform(-1.0, 1.0, (x.size1(), sizes.size))
    return np.array(function(given, points)).T  # all points in one call


def contact_functions(law: ContactLaw, target: Target) -> list[Any]:
    """SX functions of law and target, whose inputs `law` and `target` are columns of parameters.

    For a linear law

        law_slopes (law) -> k, d of f = k x + d dx/dt (2, 2): in restitution, in compression

    and for a nonlinear one, each value followed by its derivatives by penetration and rate (3):

        law_compressing, law_restoring (x, rate, law) -> force, in compression never below zero
        separation (x, rate, law) -> function that becomes negative at the end of contact

    target_slopes (z, force, target) -> d(dz/dt)/dz, d(dz/dt)/df, d(velocity)/dz, in the mode of z
    switch_slopes (z, force, target) -> switches, and their derivatives by z and force
    """
    of_target, z = ca.SX.sym("target", len(target.parameters)), ca.SX.sym("z", target.n_states)
    force, p = ca.SX.sym("force"), dict(zip(target.parameters, ca.vertsplit(of_target), strict=True))
    states = [z[i] for i in range(target.n_states)]
    rates = ca.vertcat(ca.SX(0, 1), *target.derivative(states, force, p))
    velocity = ca.SX(target.velocity(states, p))
    switches = ca.vertcat(ca.SX(0, 1), *target.switches(states, force, p))
    known = [z, force, of_target]

    def dense(*parts: Any) -> list[Any]:
        return [ca.densify(part) for part in parts]

    return [
        *_law_functions(law),
        ca.Function(
            "target_slopes",
            known,
            dense(ca.jacobian(rates, z), ca.jacobian(rates, force), ca.jacobian(velocity, z)),
        ),
        ca.Function(
            "switch_slopes", known, dense(switches, ca.jacobian(switches, z), ca.jacobian(switches, force))
        ),
    ]


def _law_functions(law: ContactLaw) -> list[Any]:
    numbers, ((restitution, at), (compression, _)) = _law_parts(law)
    if law_is_linear(law):
        slopes = [ca.jacobian(f, at) for f in (restitution, compression)]
        columns = [ca.substitute(slope, at, ca.SX.zeros(2)).T for slope in slopes]
        return [ca.Function("law_slopes", [numbers], [ca.densify(ca.horzcat(*columns))])]
    x, rate = ca.SX.sym("x"), ca.SX.sym("rate")
    p = dict(zip(law.parameters, ca.vertsplit(numbers), strict=True))
    separation = ca.substitute(ca.SX(law.separation(x, rate, p)), ca.vertcat(x, rate), at)
    parts = {
        "law_compressing": ca.if_else(compression > 0, compression, 0.0),
        "law_restoring": restitution,
        "separation": separation,
    }
    made = []
    for name, f in parts.items():
        with_slopes = ca.substitute(ca.vertcat(f, ca.jacobian(f, at).T), at, ca.vertcat(x, rate))
        made.append(ca.Function(name, [x, rate, numbers], [ca.densify(with_slopes)]))
    return made


def _law_parts(law: ContactLaw) -> tuple[Any, list[tuple[Any, Any]]]:
    """Symbols of the parameters, and (force, (x, rate)) in restitution and in compression."""
    numbers, x = ca.SX.sym("law", len(law.parameters)), ca.SX.sym("x", 2)
    p = dict(zip(law.parameters, ca.vertsplit(numbers), strict=True))
    return numbers, [(ca.SX(law.branch(x[0], x[1], c, p)), x) for c in (False, True)]


def _target_part(target: Target) -> tuple[Any, tuple[Any, Any]]:
    """Symbols of the parameters, and ((rates, velocity, switches), (state, force))."""
    numbers, x = ca.SX.sym("target", len(target.parameters)), ca.SX.sym("x", target.n_states + 1)
    p = dict(zip(target.parameters, ca.vertsplit(numbers), strict=True))
    *states, force = [x[i] for i in range(target.n_states + 1)]
    moved = [*target.derivative(states, force, p), target.velocity(states, p)]
    return numbers, (ca.SX(ca.vertcat(*moved, *target.switches(states, force, p))), x)


# default step [s] by method: spacing of the histories of implicit steps; the paper's Runge-Kutta steps
STEPS = {"implicit": 1e-3, "rk4": 1e-4}
_MOST_STEPS = 50_000  # to the horizon
TAKE_FULL = "take FullDynamics ([at_contact] model, or --model: 'full')"


@dataclass(frozen=True, kw_only=True, eq=False)
class SteppedModel(CollisionModel):
    """A collision model with frozen dynamics that is integrated in time.

    Attributes
    ----------
    effects : effects that are taken into account.
    method : integration method of the frozen system. "implicit" (None): L-stable steps of order eight that
        end on events and choose their own length. Without a C compiler SciPy's LSODA takes their place: the
        same results within the tolerance, some hundred times slower, without derivatives. "rk4": the paper's
        fixed Runge-Kutta steps, exact to 1e-2 of the impulse (of a plastic impact's, if contact ends early).
        `collide` refuses steps whose estimated error is larger.
    step : [s]. With "rk4" the length of its steps, below `stable_step(q)`; None: the paper's 1e-4. With
        "implicit", which chooses its own steps, the spacing of histories; None: 1e-3. Of shorter contacts
        histories have the ends alone, where there is no force: give a tenth of the contact's duration.
    tolerance : with "implicit", the permitted error of one step: in the hand's speed and in the impulse,
        relative to their changes, and in the target's switching functions, relative to their terms. The
        impulse is mostly as exact as that. Errors add up in long contacts in which a servo oscillates
        undamped or saturates repeatedly.
    contact_friction : of the striking point on the target. Only with "rk4", which is then the method (None).
    report : called with a line of text while functions are compiled; None: the lines go to the logger
        "impactopt", with level INFO.

    Raises
    ------
    InputError : as `CollisionModel`; an unknown method, or "implicit" with contact_friction; a step that is
        not positive, or makes too many steps.
    """

    effects: Effects = field(default_factory=Effects)
    method: str | None = None
    step: float | None = None
    tolerance: float = 1e-7
    contact_friction: ContactFriction | None = None
    report: Callable[[str], None] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method is not None:
            check_choice("method", self.method, STEPS)
        check_friction("contact_friction", self.contact_friction, self.target)
        if self.contact_friction is not None and self.method == "implicit":
            raise InputError("method 'implicit': its steps have no contact_friction; give 'rk4', or none")
        if not 1e-14 <= check_array("tolerance", self.tolerance, ()) <= 1e-2:
            raise InputError(f"tolerance: {self.tolerance:g}; give a number from 1e-14 to 1e-2")
        check_positive("step [s]", self.step_length)
        if self.step_length > self.horizon:
            raise InputError(f"step [s]: {self.step_length:g} is longer than the horizon, {self.horizon:g} s")
        steps = ceil(self.horizon / self.step_length)
        if steps > _MOST_STEPS:
            raise InputError(
                f"step [s]: {self.step_length:g} takes {steps} steps to the horizon, {self.horizon:g} s, and "
                f"{_MOST_STEPS} are the most: shorten the horizon, or lengthen the step"
            )
        # checks the settings now, and not at their first use
        _ = self.settings

    # ------------------------------------------------------------ contents of the model
    @property
    def joint_friction(self) -> JointFriction:
        """Friction of the joints; zero unless a model has it."""
        return JointFriction()

    @property
    def n_servos(self) -> int:
        """Number of joints whose servos act: all, or none of a point mass."""
        return self.robot.n

    @property
    def n_freezes(self) -> int:
        """Number of further freezes, besides the one at contact."""
        return 0

    @property
    def moves_target(self) -> bool:
        """True if friction moves the target across the normal."""
        return moves_target(self.contact_friction)

    @property
    def stepping(self) -> str:
        """The method, or its default."""
        return self.method or ("implicit" if self.contact_friction is None else "rk4")

    @property
    def step_length(self) -> float:
        """The step [s], or the method's default."""
        return min(STEPS[self.stepping], self.horizon) if self.step is None else self.step

    @property
    def step_of_graph(self) -> float:
        """Runge-Kutta step of `graph` [s]: the model's or the paper's, as a graph cannot choose its steps."""
        return self.step_length if self.stepping == "rk4" else min(STEPS["rk4"], self.horizon)

    @cached_property
    def settings(self) -> Settings:
        """Parameters that are inputs of the functions, with their default values."""
        return Settings(self.law, self.target, self.normal, self._servo_settings(), self.contact_friction)

    def _servo_settings(self) -> dict[str, ArrayLike]:
        return {}

    def check_step(self, longest: float, where: str = "here") -> None:
        """InputError if the step is not shorter than the longest stable one [s]."""
        if self.step_length >= longest:
            more = ", or the friction at the hit more slip_speed" if self.contact_friction else ""
            raise InputError(
                f"step [s]: {self.step_length:g} is unstable {where}, where the fastest mode allows "
                f"{longest:.2g}: give {type(self).__name__} a step below that, or the joints less kd or more "
                f"armature{more}, or {TAKE_FULL}"
            )

    def check_grips(self, v: NDArray[np.float64] | None = None) -> None:
        """InputError if a soft grip moves at contact at v (..., nv); None: an input, so it may move.

        The reference of all joints coasts in these models, but a spring's angle of rest does not move.
        """
        grips = self.robot.sprung & bool(self.n_servos and self.effects.stiffness)
        if not grips.any() or (v is not None and not v[..., -self.robot.n :][..., grips].any()):
            return
        names = ", ".join(np.array(self.robot.joint_names)[grips])
        raise InputError(
            f"{names}: in {type(self).__name__} the rest angle of a soft grip's spring would move with the "
            f"joint, and the grip moves at contact: {TAKE_FULL}"
        )

    @cached_property
    def available(self) -> tuple[str, ...]:
        """Names of the outputs that this model has, out of `impactopt.collision.OUTPUTS`."""
        missing = set() if self.n_servos else {*OF_SERVO}
        if not self.held_by.soles(self.robot):
            missing |= {*OF_SOLES}
        if not self.held_by.hand_frames(self.robot):
            missing.add("hand_wrench")
        if not self.target.results:
            missing.add("target_result")
        if not self.moves_target:
            missing.add("tangential_velocity")
        if self.stepping == "implicit":
            missing.add("step_error")
        return tuple(name for name in OUTPUTS if name not in missing)

    @cached_property
    def _recipe(self) -> tuple[Any, ...]:
        """Cache key of the functions: all that their code depends on; the settings' values are inputs."""
        held = (self.held_by.sole_frames(self.robot), self.held_by.hand_frames(self.robot))
        held_by = (*held, tuple(self.held_by.compliance))
        transition = self.joint_friction.transition if self.effects.friction else None
        linear = (law_is_linear(self.law), target_is_linear(self.target))
        contact = (self.law.formula(), self.target.formula(), *linear, self.effects, transition)
        shapes = tuple((name, value.shape) for name, value in self.settings.items())
        frame = self.robot.striker(self.striker).model_frame
        steps = (self.stepping, self.step_length, self.tolerance, self.step_of_graph)
        rubs = (self.contact_friction is not None, *(("moves",) if self.moves_target else ()))
        integration = (*steps, self.horizon, self.n_freezes, *rubs)
        dynamics = model_hash(self.robot.model, self.robot.springs)
        return (dynamics, self.n_servos, frame, *held_by, *contact, shapes, *integration)


def number_of_steps(collision: SteppedModel, fraction: float = 1.0) -> int:
    """Number of Runge-Kutta steps that reach this fraction of the horizon."""
    return ceil(fraction * collision.horizon / collision.step_of_graph - 1e-9)
