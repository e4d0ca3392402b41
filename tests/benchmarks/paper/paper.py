"""What the paper prints: the setting of its section III, and Tables I to III, digit by digit."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.cases import PAPER_MASSES, PAPER_SPEEDS
from impactopt.contact import FreeMass, SpringDamper

LAW = SpringDamper(stiffness=1e4, damping=300.0)
TARGET = FreeMass(mass=5.0)
STEP = 1e-4  # [s] of its Runge-Kutta method


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A row of Table I: virtual mass [kg] and collision speed [m/s]."""

    mass: float
    speed: float


MOTIONS = {
    f"{letter}-{k}": Motion(mass=mass, speed=speed)
    for letter, mass in PAPER_MASSES.items()
    for k, speed in enumerate(PAPER_SPEEDS, 1)
}


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Half a row of Table II or III: peak force [N], impulse [N s], and their errors [%] by eq. (24), where
    an estimate that is too small is positive; None for OpenHRP3's own numbers."""

    f_max: float
    impulse: float
    f_max_error: float | None = None
    impulse_error: float | None = None


def _estimates(text: str) -> dict[str, Estimate]:
    keys = ("f_max", "f_max_error", "impulse", "impulse_error")
    rows = (line.split() for line in text.strip().splitlines())
    return {name: Estimate(**dict(zip(keys, map(float, rest), strict=True))) for name, *rest in rows}


# OpenHRP3's f_max and f_n
OPENHRP3 = {
    name: Estimate(f_max=f_max, impulse=impulse)
    for name, (f_max, impulse) in {
        "A-1": (122.6, 2.6),
        "A-2": (215.7, 4.5),
        "A-3": (299.3, 6.6),
        "B-1": (121.3, 2.5),
        "B-2": (209.1, 4.5),
        "B-3": (301.3, 6.5),
        "C-1": (119.6, 2.8),
        "C-2": (211.3, 4.8),
        "C-3": (299.5, 7.1),
    }.items()
}

# of the simplified dynamics computation: f_max, f_err, f_n, f_nerr
TABLE_2 = _estimates(
    """
    A-1  119.7   2.3  2.6  -0.4
    A-2  209.9   2.7  4.6  -1.2
    A-3  300.4  -0.4  6.5   0.7
    B-1  119.7   1.2  2.7  -6.1
    B-2  209.9  -0.4  4.7  -4.5
    B-3  300.4   0.3  6.7  -2.4
    C-1  120.1  -0.4  2.7   0.6
    C-2  210.2   0.5  4.8   0.2
    C-3  300.7  -0.4  6.9   4.0
    """
)

# of the virtual mass
TABLE_3 = _estimates(
    """
    A-1  119.7   2.3  1.2  53.2
    A-2  209.9   2.7  2.1  52.8
    A-3  300.2  -0.3  3.0  53.7
    B-1  119.7   1.3  1.5  39.9
    B-2  209.9  -0.4  2.7  40.8
    B-3  300.2   0.3  3.8  42.1
    C-1  119.8  -0.2  1.7  37.3
    C-2  210.4   0.4  3.0  36.9
    C-3  300.6  -0.4  4.3  39.4
    """
)
