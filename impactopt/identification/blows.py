"""The contacts in a log, each with the samples about it that are fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from impactopt.errors import InputError
from impactopt.identification.log import FORCE, SPEED, TIME, ImpactLog

__all__ = ["Blow", "find_blows", "noise_of"]

Array = NDArray[np.float64]
_LEAST, _SMALL = 0.1, 0.2  # of the largest force: what counts as contact, and as a blow of its own
_SAMPLES = 8  # in contact, at least
# a top is flat where so many samples in a row are within these shares of the noise and of the peak; unless it
# is quantized: the top of a parabola falls by 3 steps over half its length beyond either end
_FLAT, _ALIKE, _EQUAL, _STEPS = 4, 0.1, 1e-6, 6.0
_BEFORE, _AFTER = 0.5, 0.25  # of the contact's duration: what is looked at before the touch and after the end
# beyond these, units are doubted
_LONGEST, _FASTEST, _LIGHTEST, _HEAVIEST = 1.0, 50.0, 1e-3, 1e4  # s, m/s, kg, kg


@dataclass(frozen=True, eq=False)
class Blow:
    """One contact: samples (k,) of time [s], force [N] and motion, and what is plain to see of it.

    motion : speed [m/s], or travel [m].  travels : which of them.  clipped (k,) : samples whose force was
    beyond the sensor's range.  touch : index of the first sample in contact.  duration [s], speed [m/s] at
    contact, mass [kg]: first estimates.  model_mass [kg]: by the robot's model, at the touch; nan where it
    is not known.
    """

    time: Array
    force: Array
    motion: Array
    clipped: NDArray[np.bool_]
    travels: bool
    touch: int
    duration: float
    speed: float
    mass: float
    model_mass: float

    @property
    def peak(self) -> float:
        """[N]"""
        return float(self.force.max())


def _clipped(force: Array) -> NDArray[np.bool_]:
    """Samples (k,) of a log at which its force is cut off: at its largest, if that has a flat top."""
    top = float(force.max())
    at_top = force >= top - max(_ALIKE * noise_of(force), _EQUAL * top)
    step = float(np.diff(np.unique(force)).min(initial=np.inf))
    for begin, end in np.flatnonzero(np.diff(np.concatenate([[0], at_top, [0]]))).reshape(-1, 2):
        beyond = (end - begin) // 2
        sides = [force[k] for k in (begin - 1 - beyond, end + beyond) if 0 <= k < len(force)]
        if end - begin >= _FLAT and top - max(sides, default=-np.inf) > _STEPS * step:
            return at_top
    return np.zeros(len(force), dtype=bool)


def noise_of(values: Array) -> float:
    """Standard deviation of white noise on values (k,) of a smooth course, from their second differences."""
    if len(values) < 3:
        return 0.0
    # robust: a fifth of them may be jumps and bends
    return float(np.quantile(np.abs(np.diff(values, 2)), 0.8) / (1.2816 * np.sqrt(6)))


def find_blows(log: ImpactLog) -> tuple[Blow, ...]:
    """The contacts of a log.

    Raises
    ------
    InputError : no contact, a force of the wrong sign, too few samples, a log that begins or ends in contact,
        a hand that does not come; numbers that look like other units.
    """
    peak, name = float(log.force.max()), log.name
    noise = noise_of(log.force)
    if -log.force.min() > max(peak, 8 * noise, 0.0):
        raise InputError(
            f"{name}: {FORCE} goes down to {log.force.min():.4g} N, and up to {peak:.4g} N only; the "
            "force on the target counts along the blow: turn its sign"
        )
    # unlike a blow, noise is as often below the median as above
    middle = float(np.median(log.force))
    if peak <= 0 or peak - middle < max(6 * noise, 2 * (middle - float(log.force.min()))):
        raise InputError(f"{name}: no contact: {FORCE} is at most {peak:.4g} N, which its noise is too")
    spans = _spans(log.force, max(_LEAST * peak, 4.5 * noise))
    spans = [span for span in spans if log.force[slice(*span)].max() > _SMALL * peak]
    clipped = _clipped(log.force)
    return tuple(_blow(log, span, spans, noise, clipped) for span in spans)


def _spans(force: Array, least: float) -> list[tuple[int, int]]:
    """(begin, end) of what is above a force [N]; gaps are noise if they are short, or have force in them."""
    inside = force > least
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    spans: list[tuple[int, int]] = []
    for begin, end in edges.reshape(-1, 2):
        gap = force[spans[-1][1] : begin] if spans else force
        if spans and (len(gap) <= 2 or gap.mean() > least / 2):
            spans[-1] = (spans[-1][0], int(end))
        else:
            spans.append((int(begin), int(end)))
    return spans


def _blow(
    log: ImpactLog,
    span: tuple[int, int],
    spans: list[tuple[int, int]],
    noise: float,
    clipped: NDArray[np.bool_],
) -> Blow:
    (begin, end), t, f, name = span, log.time, log.force, log.name
    quiet = max(2 * noise, 1e-3 * float(f[begin:end].max()))
    before = max((e for _, e in spans if e <= begin), default=0)
    after = min((b for b, _ in spans if b >= end), default=len(t))
    while begin > before and f[begin - 1] > quiet:
        begin -= 1
    while end < after and f[end] > quiet:
        end += 1
    where = f"{name}, blow at {t[begin]:.6g} s"
    if begin == 0 or end == len(t):
        raise InputError(
            f"{where}: the log {'begins' if begin == 0 else 'ends'} in contact; it has to begin before the "
            "touch, and to end after the hand has left; take an offset off the force first"
        )
    duration = float(t[end] - t[begin])
    if duration > _LONGEST:
        raise InputError(
            f"{where}: the contact lasts {duration:.3g} s, which is no blow; is {TIME} in milliseconds?"
        )
    if end - begin < _SAMPLES:
        raise InputError(
            f"{where}: {end - begin} samples in contact; at least {_SAMPLES} are needed: log at "
            f"{1.5 * _SAMPLES / duration:.0f} Hz or more"
        )
    low = int(np.searchsorted(t, t[begin] - _BEFORE * duration))
    high = int(np.searchsorted(t, t[end] + _AFTER * duration, side="right"))
    low, high = max(min(low, begin - 5), before, 0), min(max(high, end + 5), after, len(t))
    motion = log.travel if log.speed is None else log.speed
    assert motion is not None
    mean = _mean_slope if log.speed is None else _mean
    speed = mean(t[low:begin], motion[low:begin])
    if not speed > 0:
        raise InputError(
            f"{where}: the hand moves at {speed:.3g} m/s before the touch; its speed towards the target is "
            "positive: turn its sign, or that of the normal"
        )
    if speed > _FASTEST:
        raise InputError(f"{where}: the hand comes at {speed:.4g} m/s; is {SPEED} in mm/s?")
    impulse = float(trapezoid(f[begin:end], t[begin:end]))
    lost = speed - mean(t[end:high], motion[end:high])
    mass = impulse / (lost if lost > 0.2 * speed else 1.5 * speed)
    if not _LIGHTEST < mass < _HEAVIEST:
        raise InputError(
            f"{where}: {impulse:.3g} N s take {max(lost, 0.0):.3g} of {speed:.3g} m/s from the hand, as of a "
            f"mass of {mass:.3g} kg; are all columns in s, N and m/s?"
        )
    return Blow(
        time=t[low:high],
        force=f[low:high],
        motion=motion[low:high],
        clipped=clipped[low:high],
        travels=log.speed is None,
        touch=begin - low,
        duration=duration,
        speed=speed,
        mass=mass,
        model_mass=np.nan if log.model_mass is None else float(log.model_mass[begin]),
    )


def _mean(time: Array, speed: Array) -> float:
    return float(speed.mean()) if len(speed) else np.nan


def _mean_slope(time: Array, travel: Array) -> float:
    return float(np.polyfit(time - time[0], travel, 1)[0]) if len(time) > 1 else np.nan
