"""Simplified dynamics computation of a collision (paper, section II-B), and the point-mass model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from numpy.typing import ArrayLike

from impactopt.collision.checks import caution, more_often
from impactopt.collision.settings import Effects, JointFriction, servo_settings
from impactopt.collision.symbolic import SymbolicModel
from impactopt.contact import ContactFriction, ContactLaw, FreeMass, SpringDamper, Target
from impactopt.errors import InputError, check_array, check_choice, check_kind, check_whole
from impactopt.kinematics.stance import BothSoles, FixedBase, Stance
from impactopt.robots.robot import Robot


@dataclass(frozen=True, kw_only=True, eq=False)
class VirtualMass(SymbolicModel):
    """Point mass with the robot's effective mass m_a = 1 / (n' J P J' n), without servo and gravity.

    The simplest model of the hierarchy (paper, fig. 9, Table III; after Asada and Ogawa, and Khatib): P is
    the inverse inertia of the constrained robot. Joint torques, sole wrenches and ZMP are None in its
    results; the velocity after the collision is that of free joints. Attributes and errors as of
    `SymbolicModel`.
    """

    effects: Effects = field(init=False, default=Effects.none())

    @property
    def n_servos(self) -> int:
        return 0


@dataclass(frozen=True, kw_only=True, eq=False)
class SDC(SymbolicModel):
    """Simplified dynamics computation: robot and target from contact to separation, with H and J frozen.

    Attributes as of `SymbolicModel`, and

    Attributes
    ----------
    friction : of the joints, with effects.friction.
    kp, kd : servo stiffness [N m/rad] and damping [N m s/rad]: one number a joint (n), one for all, or
        matrices (n, n) (paper, eq. 10); None: the robot's.
    freezes : number of further freezes of H, J and the bias during contact; 0: only at contact, as in the
        paper. The error falls with 1/freezes^2; four take some five times as long as none.
    accuracy : required relative accuracy of the impulse. `collide` estimates the error of freezing from a
        collision with at least twice as many freezes: `Collision.freeze_error`. If it is larger than this,
        `Collision.caution` warns. In compiled code the estimate makes a collision frozen at contact only some
        six times as slow, one with four freezes twice, and one more function is compiled. None: no estimate.
        The estimate does not include effects that the model omits.

    Raises
    ------
    InputError : as `SymbolicModel`; effects.friction without `friction`, or vice versa; freezes that are not
        a whole number >= 0; an accuracy that is not positive. With effects.stiffness, in `collide` and
        `batch`: a soft grip that moves at contact; in `function`, `graph` and derivatives: any soft grip.
    """

    friction: JointFriction | None = None
    kp: ArrayLike | None = None
    kd: ArrayLike | None = None
    freezes: int = 0
    accuracy: float | None = 1e-2

    def __post_init__(self) -> None:
        check_kind("effects", self.effects, Effects)
        if self.friction is not None:
            check_kind("friction", self.friction, JointFriction)
        if self.effects.friction and self.friction is None:
            raise InputError("effects.friction is on: give friction=JointFriction(viscous=..., coulomb=...)")
        if self.friction is not None and not self.effects.friction:
            raise InputError(
                "friction is given, but effects.friction is off: switch it on, or leave friction out"
            )
        object.__setattr__(self, "freezes", check_whole("freezes", self.freezes, least=0, most=10**6))
        if self.accuracy is not None and not check_array("accuracy", self.accuracy, ()) > 0:
            raise InputError(f"accuracy: {self.accuracy:g}; give a number > 0, or None for no estimate")
        super().__post_init__()

    @classmethod
    def paper(
        cls,
        robot: Robot,
        *,
        striker: str,
        normal: ArrayLike,
        law: ContactLaw | None = None,
        target: Target | None = None,
        stance: Stance | None = None,
        friction: JointFriction | None = None,
        contact_friction: ContactFriction | None = None,
        horizon: float = 0.1,
        report: Callable[[str], None] | None = None,
    ) -> SDC:
        """The paper's model: servo damping and saturation (eqs. 11, 12), and friction if it is given.

        It takes Runge-Kutta steps of 1e-4 s, as in the paper's section III. Defaults of law, target and
        stance are the paper's: k = 1e4 N/m, d = 300 N s/m, a free mass of 5 kg, and virtual bases of 1e5 kg
        and 1e5 kg m2.

        The error of freezing is not estimated, as the effects that this model omits cause a larger one.
        """
        if stance is None:
            stance = BothSoles(base_mass=1e5, base_inertia=1e5) if robot.floating else FixedBase()
        return cls(
            robot=robot,
            striker=striker,
            normal=normal,
            law=law or SpringDamper(stiffness=1e4, damping=300.0),
            target=target or FreeMass(mass=5.0),
            stance=stance,
            effects=Effects.paper(friction=friction is not None),
            friction=friction,
            contact_friction=contact_friction,
            method="rk4",
            step=1e-4,
            horizon=horizon,
            report=report,
            accuracy=None,
        )

    @property
    def joint_friction(self) -> JointFriction:
        return self.friction or JointFriction()

    @property
    def n_freezes(self) -> int:
        return self.freezes

    @cached_property
    def _more_often(self) -> SDC | None:
        if self.accuracy is None:
            return None
        return replace(self, freezes=more_often(self.freezes))

    def _caution(self, error: float) -> str:
        return "" if self.accuracy is None else caution(error, self.accuracy, self.freezes)

    def _servo_settings(self) -> dict[str, ArrayLike]:
        return servo_settings(self.robot, self.effects, self.joint_friction, self.kp, self.kd)


FROZEN = ("virtual-mass", "sdc-paper", "sdc")


def frozen_model(
    name: str, freezes: int = 0, *, accuracy: float | None = None, **scene: Any
) -> SymbolicModel:
    """Collision model that plans with `ImpactProblem.collision` of this name contain.

    As in plans, it takes implicit steps, and "sdc-paper" has the soles of the stance fixed without a virtual
    base. In these two points `SDC.paper` by itself follows the paper.

    Parameters
    ----------
    name : one of `FROZEN`.
    freezes, accuracy : of "sdc": as of `SDC`.
    scene : robot, striker, normal, law, target, stance, horizon, contact_friction: as of `SDC`.

    Raises
    ------
    InputError : an unknown name; as the models.
    """
    check_choice("no model with frozen dynamics is called", name, FROZEN)
    if name == "virtual-mass":
        return VirtualMass(**scene)
    if name == "sdc-paper":
        return replace(SDC.paper(**scene), method=None, step=None)
    return SDC(**scene, freezes=freezes, accuracy=accuracy)
