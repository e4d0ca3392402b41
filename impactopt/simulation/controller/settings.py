"""Settings of the whole-body controller, and choice of a controller by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from impactopt.contact.fields import Described, about, abouts
from impactopt.errors import check_choice, check_whole

CONTROLLERS = ("servo", "wbc")

IMPACTS = ("planned", "none", "project", "spread", "both")
FOLLOWS = ("recover", "plan")


def _weight(what: str) -> Any:
    return about(f"weight of {what}", least=0, most=1e9)


@dataclass(frozen=True, kw_only=True)
class ControllerSettings(Described):
    """Settings of the whole-body controller that follows a plan in a replay.

    Its weights are those of squared errors in accelerations: of the centre of mass [m/s^2], of the angular
    momentum's rate over mass [m^2/s^2], of the hand [m/s^2] and of joints and trunk [rad/s^2].
    """

    rate: float = field(
        default=1000.0,
        metadata=about("sampling rate of the control", unit="Hz", least=100, most=10_000, key="rate_Hz"),
    )
    delay: float = field(
        default=1e-3,
        metadata=about("from reading the sensors to setting the torque", unit="s", least=0, most=0.1),
    )
    noise: float = field(
        default=1.0, metadata=about("factor of the sensors' errors; 0: none", least=0, most=100)
    )
    seed: int = field(default=0, metadata=about("seed of the sensors' errors", least=0))
    impact: str = field(
        default="planned",
        metadata=about(
            "feedback about the impact: as always, impact-invariant projection, reference spreading, both; "
            "planned: both with the plan's servos in contact",
            choices=IMPACTS,
        ),
    )
    follow: str = field(
        default="recover",
        metadata=about(
            "after the impact: the plan's follow-through; recover: slower, and farther inside the soles",
            choices=FOLLOWS,
        ),
    )
    recovery_start: float = field(
        default=0.2, metadata=about("begin of the recovery, after the impact", unit="s", least=0, most=1000)
    )
    recovery_pace: float = field(
        default=0.5, metadata=about("pace of the recovery; 1: the plan's", above=0, most=1)
    )
    recovery_margin: float = field(
        default=0.1,
        metadata=about(
            "margin of the centre of mass in the soles after it, if they have as much",
            unit="m",
            least=0,
            most=1,
        ),
    )
    draw_back: float = field(
        default=0.03,
        metadata=about(
            "how far a hand with a soft grip draws back after the impact",
            unit="m",
            least=0,
            most=1,
        ),
    )
    com: float = field(default=10.0, metadata=_weight("the centre of mass"))
    angular_momentum: float = field(default=1.0, metadata=_weight("the angular momentum"))
    hand: float = field(default=1.0, metadata=_weight("the hand"))
    posture: float = field(default=0.001, metadata=_weight("the posture"))
    torque: float = field(default=0.01, metadata=_weight("torques over their limits, against the plan's"))
    wrench: float = field(
        default=10.0, metadata=_weight("the soles' wrenches over the robot's weight, against the plan's")
    )
    sole_bandwidth: float = field(
        default=25.0,
        metadata=about("bandwidth of keeping the soles flat", unit="rad/s", least=0, most=1000),
    )
    blow: float = field(default=1000.0, metadata=_weight("torques in contact, against the plan's servos"))
    capture_gain: float = field(
        default=4.0,
        metadata=about("gain of the divergent component of motion", unit="1/s", least=0, most=1000),
    )
    momentum_gain: float = field(
        default=5.0, metadata=about("gain of the angular momentum", unit="1/s", least=0, most=1000)
    )
    hand_bandwidth: float = field(
        default=20.0, metadata=about("bandwidth of the hand's feedback", unit="rad/s", least=0, most=1000)
    )
    posture_bandwidth: float = field(
        default=15.0, metadata=about("bandwidth of the posture's feedback", unit="rad/s", least=0, most=1000)
    )
    recovery_bandwidth: float = field(
        default=12.0,
        metadata=about("bandwidth of the same in the recovery", unit="rad/s", least=0, most=1000),
    )
    friction: float = field(
        default=0.6, metadata=about("friction coefficient that it counts on", above=0, most=10)
    )
    cop_margin: float = field(
        default=0.003,
        metadata=about("distance of a sole's centre of pressure from its edges", unit="m", least=0, most=1),
    )
    least_force: float = field(
        default=10.0,
        metadata=about(
            "least normal force of each sole; of all together a quarter of the weight at most",
            unit="N",
            least=0,
            most=1e6,
        ),
    )
    iterations: int = field(
        default=30, metadata=about("iterations of OSQP in each QP", least=1, most=100_000)
    )

    def __post_init__(self) -> None:
        for f, description in abouts(type(self)):
            value = getattr(self, f.name)
            name = f"controller: {f.name}"
            if description.choices:
                check_choice(name, value, description.choices)
            elif f.name in ("seed", "iterations"):
                check_whole(name, value, least=int(description.least or 0), most=10**9)
            else:
                description.checked(name, value)

    @property
    def period(self) -> float:
        """[s] between two samples."""
        return 1.0 / self.rate

    @property
    def projects(self) -> bool:
        """True if velocity errors are projected about the impact."""
        return self.impact in ("project", "both", "planned")

    @property
    def spreads(self) -> bool:
        """True if the reference is spread about the impact."""
        return self.impact in ("spread", "both", "planned")


def controller_of(
    chosen: str | ControllerSettings | None, settings: ControllerSettings | None = None
) -> ControllerSettings | None:
    """Settings of the chosen whole-body controller; None: the joints' servo.

    chosen : "servo" or None; "wbc", with `settings`, by default the standard ones; or settings themselves.

    Raises
    ------
    InputError : there is no such controller.
    """
    if isinstance(chosen, ControllerSettings):
        return chosen
    if chosen is None or chosen == "servo":
        return None
    check_choice("unknown controller", chosen, CONTROLLERS)
    return settings if settings is not None else ControllerSettings()
