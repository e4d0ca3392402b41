"""Result of an identification: parameters with intervals, for each law."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from impactopt.contact.fields import abouts
from impactopt.contact.laws import ContactLaw
from impactopt.errors import InputError, counted
from impactopt.files.toml import write_toml
from impactopt.identification.free_parameters import MASS

_MAX_WIDTH = 1.0  # of the interval of a determined parameter, over its value
_DIGITS = 5  # of parameters in a file
_MAX_CORRELATION = 4.0  # of white noise, in standard deviations
_INTERPOLATION_ERROR = 0.05  # [% of the largest force or motion] residual of a log without noise
_LIGHT = 0.05  # [kg] no robot's effective mass is less
_LISTED = 5  # times of contacts that are left out
_TIE = 10.0  # difference of AIC below which a log cannot distinguish laws


@dataclass(frozen=True)
class Estimate:
    """A parameter's value, confidence interval, and unit."""

    value: float
    low: float
    high: float
    unit: str = ""

    @property
    def determined(self) -> bool:
        """True if the interval is narrower than the parameter is large, and excludes 0."""
        return bool(self.high - self.low <= _MAX_WIDTH * abs(self.value) and self.low * self.high > 0)

    def describe(self) -> dict[str, Any]:
        """JSON form: value, low, high, unit, determined; None for an infinite end."""
        ends = {name: x if np.isfinite(x) else None for name, x in (("low", self.low), ("high", self.high))}
        return {"value": self.value, **ends, "unit": self.unit, "determined": self.determined}


@dataclass(frozen=True, kw_only=True)
class LawFit:
    """Fit of one law to all impacts of a log together.

    law : with the fitted parameters
    estimates : of its parameters and of `effective_mass`, by name
    speeds, touches : speed [m/s] of each impact at the touch, and instant [s] of the touch
    held : fixed parameters, by name
    force_left [N] : root mean square of the force's residuals
    force_left_pct : the same, in % of the largest force
    motion_left : root mean square of the motion's residuals [m/s], or [m] for joint positions
    motion_left_pct : the same, in % of the largest speed, or of the largest product of speed and contact time
    correlation, motion_correlation : of the residuals of force and of motion at neighbouring samples; about 0
        for white noise, closer to 1 the less the law, or the two masses, fit
    aic : Akaike's information criterion, with unknown noise of force and motion; only differences between
        laws are meaningful
    """

    law: ContactLaw
    estimates: Mapping[str, Estimate]
    speeds: tuple[Estimate, ...]
    touches: tuple[float, ...]
    held: Mapping[str, float]
    force_left: float
    force_left_pct: float
    motion_left: float
    motion_left_pct: float
    correlation: float
    motion_correlation: float
    aic: float

    def __repr__(self) -> str:
        """One line with the estimates."""
        found = ", ".join(f"{name} {x.value:.4g} {x.unit}" for name, x in self.estimates.items())
        return f"<{self.name}: {found}; residual {self.force_left_pct:.2g} % of the peak force>"

    @property
    def name(self) -> str:
        """Name of the law in problem files, or its class."""
        return self.law.word or type(self.law).__name__

    @property
    def effective_mass(self) -> Estimate:
        """Effective mass [kg] of the hand."""
        return self.estimates[MASS]

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the parameters that the log does not determine."""
        return tuple(name for name, each in self.estimates.items() if not each.determined)

    def describe(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "law": self.name,
            "estimates": {name: each.describe() for name, each in self.estimates.items()},
            "undetermined": list(self.undetermined),
            "held": dict(self.held),
            "speed_m_s": [each.describe() for each in self.speeds],
            "touch_s": list(self.touches),
            "force_left_N": self.force_left,
            "force_left_pct": self.force_left_pct,
            "motion_left": self.motion_left,
            "motion_left_pct": self.motion_left_pct,
            "correlation": self.correlation,
            "motion_correlation": self.motion_correlation,
            "aic": self.aic,
        }

    def toml(self) -> str:
        """Section `[contact]` of a problem file, with intervals as comments.

        Raises
        ------
        InputError : a user's law, which a file cannot have.
        """
        if not self.law.word:
            raise InputError(f"{type(self.law).__name__}: a file cannot have it; use it in Python")
        keys = {f.name: about.key_of(f.name) for f, about in abouts(type(self.law))}
        section: dict[str, Any] = {"law": self.law.word}
        section |= {keys[name]: float(f"{x:.{_DIGITS}g}") for name, x in self.law.parameters.items()}
        comments = {}
        for name, each in self.estimates.items():
            if name in keys:
                unsure = "" if each.determined else "; not determined by the log"
                comments[keys[name]] = f"{each.low:.4g} to {each.high:.4g}{unsure}"
        return write_toml(
            {"contact": section}, lambda place: comments.get(str(place[-1]), "") if len(place) == 2 else ""
        )


@dataclass(frozen=True, kw_only=True)
class Identification:
    """Contact laws fitted to a log.

    log : its name
    fits : of each law, the best first
    samples : number of fitted samples
    level : of the intervals
    target_mass [kg] : infinite for a fixed target
    clipped, top [N] : number of samples of each impact whose force was cut off at `top`, and is not fitted
    weak : times [s] of contacts with less than 20 % of the largest force, which are not fitted
    force_offset [N] : mean force before the touches; 0 if it may be noise
    model_mass [kg] : effective mass of each impact by the robot's model; nan if unknown
    """

    log: str
    fits: tuple[LawFit, ...]
    samples: int
    level: float
    target_mass: float
    clipped: tuple[int, ...]
    top: float
    weak: tuple[float, ...] = ()
    force_offset: float = 0.0
    model_mass: tuple[float, ...] = field(default=())

    def __repr__(self) -> str:
        """One line with the best fit."""
        return f"<Identification of {self.log!r}: best of {len(self.fits)} laws {self.best!r}>"

    @property
    def best(self) -> LawFit:
        """Fit with the least AIC."""
        return self.fits[0]

    def fit(self, law: str | type[ContactLaw]) -> LawFit:
        """Fit of one law, by its word in problem files or its class.

        Raises
        ------
        InputError : the law was not fitted.
        """
        for each in self.fits:
            if law in (each.name, type(each.law)):
                return each
        known = ", ".join(each.name for each in self.fits)
        raise InputError(f"the law {law!r} was not fitted; there are {known}")

    @property
    def cautions(self) -> tuple[str, ...]:
        """Warnings about unreliable results."""
        best, out = self.best, []
        if any(self.clipped):
            out.append(
                f"the force is cut off at {self.top:.4g} N: {sum(self.clipped)} samples of "
                f"{sum(count > 0 for count in self.clipped)} of {len(self.clipped)} impacts are left out; "
                "peak and impulse of the log are too small: log again with a sensor of a larger range"
            )
        if self.weak:
            times = ", ".join(f"{t:.4g}" for t in self.weak[:_LISTED])
            more = " ..." if len(self.weak) > _LISTED else ""
            out.append(
                f"{counted(len(self.weak), 'contact')} with less than 20 % of the largest force left out, at "
                f"{times}{more} s: give such impacts a log of their own"
            )
        if self.force_offset:
            out.append(
                f"the force before contact is {self.force_offset:.3g} N on average: subtract this offset, "
                "which makes all parameters wrong, by more than their intervals"
            )
        near = [each.name for each in self.fits[1:] if each.aic - best.aic < _TIE]
        if near:
            out.append(
                f"the log cannot distinguish {best.name} from {', '.join(near)}; impacts at other speeds may"
            )
        # a fit weighs force and motion by their residuals, so what does not fit may be left in either
        coloured = [
            f"the residual {name} of {best.name}, {pct:.2g} % of the {largest}, is not white noise "
            f"(correlation of neighbouring samples: {correlation:.2f}): {cause}, a sensor has an offset or a "
            "delay, or the log is filtered; intervals are too narrow then"
            for name, pct, largest, correlation, cause in (
                ("force", best.force_left_pct, "peak", best.correlation, "another law holds"),
                (
                    "motion",
                    best.motion_left_pct,
                    "largest",
                    best.motion_correlation,
                    "another law holds, the target has another mass, servos act",
                ),
            )
            if correlation > _MAX_CORRELATION / np.sqrt(self.samples) and pct > _INTERPOLATION_ERROR
        ]
        out += coloured
        if not coloured and len(self.fits) > 1:
            out.append("the best of these laws need not be the true one")
        if best.undetermined:
            out.append(f"the log does not determine {', '.join(best.undetermined)} of {best.name}")
        mass = best.effective_mass
        if mass.high < _LIGHT:
            out.append(f"the effective mass is {mass.value:.2g} kg, hardly a robot's: is force_N in kN?")
        known = [x for x in self.model_mass if np.isfinite(x)]
        if known and not mass.low <= float(np.mean(known)) <= mass.high:
            out.append(
                f"the robot's model has an effective mass of {np.mean(known):.3g} kg there, and the log "
                f"{mass.value:.3g} kg ({mass.low:.3g} to {mass.high:.3g}): servos, or a wrong model"
            )
        return tuple(out)

    def describe(self) -> dict[str, Any]:
        """JSON form, as `impactopt identify --json` prints it."""
        return {
            "log": self.log,
            "best": self.best.name,
            "blows": len(self.best.speeds),
            "samples": self.samples,
            "clipped": list(self.clipped),
            "weak_s": list(self.weak),
            "force_offset_N": self.force_offset,
            "level": self.level,
            "target_mass_kg": self.target_mass if np.isfinite(self.target_mass) else None,
            "model_mass_kg": [x for x in self.model_mass if np.isfinite(x)],
            "cautions": list(self.cautions),
            "laws": [each.describe() for each in self.fits],
        }
