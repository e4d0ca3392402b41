"""Settings of the whole-body controller, and choice of a controller by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from impactopt.contact.fields import Described, abouts, described
from impactopt.errors import check_choice, check_whole

CONTROLLERS = ("servo", "wbc")

IMPACTS = ("planned", "none", "project", "spread", "both")
FOLLOWS = ("recover", "plan")


def _weight(default: float, what: str) -> Any:
    return described(default, f"weight of {what}", least=0, most=1e9)


@dataclass(frozen=True, kw_only=True)
class ControllerSettings(Described):
    """Settings of the whole-body controller that follows a plan in a replay.

    Its weights are those of squared errors in accelerations: of the centre of mass [m/s^2], of the angular
    momentum's rate over mass [m^2/s^2], of the hand [m/s^2] and of joints and trunk [rad/s^2].
    """

    rate: float = described(
        1000.0, "sampling rate of the control", unit="Hz", least=100, most=10_000, key="rate_Hz"
    )
    delay: float = described(
        1e-3, "from reading the sensors to setting the torque", unit="s", least=0, most=0.1
    )
    noise: float = described(1.0, "factor of the sensors' errors; 0: none", least=0, most=100)
    seed: int = described(0, "seed of the sensors' errors", least=0)
    impact: str = described(
        "planned",
        "feedback about the impact: as always, impact-invariant projection, reference spreading, both; "
        "planned: both with the plan's servos in contact",
        choices=IMPACTS,
    )
    follow: str = described(
        "recover",
        "after the impact: the plan's follow-through; recover: slower, and farther inside the soles",
        choices=FOLLOWS,
    )
    recovery_start: float = described(
        0.2, "begin of the recovery, after the impact", unit="s", least=0, most=1000
    )
    recovery_pace: float = described(0.5, "pace of the recovery; 1: the plan's", above=0, most=1)
    recovery_margin: float = described(
        0.1,
        "margin of the centre of mass in the soles after it, if they have as much",
        unit="m",
        least=0,
        most=1,
    )
    draw_back: float = described(
        0.03, "how far a hand with a soft grip draws back after the impact", unit="m", least=0, most=1
    )
    com: float = _weight(10.0, "the centre of mass")
    angular_momentum: float = _weight(1.0, "the angular momentum")
    hand: float = _weight(1.0, "the hand")
    posture: float = _weight(0.001, "the posture")
    torque: float = _weight(0.01, "torques over their limits, against the plan's")
    wrench: float = _weight(10.0, "the soles' wrenches over the robot's weight, against the plan's")
    sole_bandwidth: float = described(
        25.0, "bandwidth of keeping the soles flat", unit="rad/s", least=0, most=1000
    )
    blow: float = _weight(1000.0, "torques in contact, against the plan's servos")
    capture_gain: float = described(
        4.0, "gain of the divergent component of motion", unit="1/s", least=0, most=1000
    )
    momentum_gain: float = described(5.0, "gain of the angular momentum", unit="1/s", least=0, most=1000)
    hand_bandwidth: float = described(
        20.0, "bandwidth of the hand's feedback", unit="rad/s", least=0, most=1000
    )
    posture_bandwidth: float = described(
        15.0, "bandwidth of the posture's feedback", unit="rad/s", least=0, most=1000
    )
    recovery_bandwidth: float = described(
        12.0, "bandwidth of the same in the recovery", unit="rad/s", least=0, most=1000
    )
    friction: float = described(0.6, "friction coefficient that it counts on", above=0, most=10)
    cop_margin: float = described(
        0.003, "distance of a sole's centre of pressure from its edges", unit="m", least=0, most=1
    )
    least_force: float = described(
        10.0,
        "least normal force of each sole; of all together a quarter of the weight at most",
        unit="N",
        least=0,
        most=1e6,
    )
    iterations: int = described(30, "iterations of OSQP in each QP", least=1, most=100_000)

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
