"""Logs of measured force and motion, and the impacts in them."""

from __future__ import annotations

import csv
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike
from scipy.integrate import trapezoid

from impactopt.arrays import Array, Mask
from impactopt.codegen.files import read_archive
from impactopt.errors import MOST, InputError, check_array, check_direction, counted, did_you_mean, shortened
from impactopt.kinematics.operational_space import ConstrainedDynamics
from impactopt.robots.robot import Robot

TIME, FORCE, SPEED = "time_s", "force_N", "hand_speed_m_s"
# bytes and arrays of an npz file: an hour of 15 columns at 1 kHz has 430 MB
MAX_BYTES, MAX_ARRAYS = 1 << 29, 1000
_MAX_BEYOND = 2 * np.pi  # [rad] of a joint beyond its limits; farther, it is probably in degrees


@dataclass(frozen=True, kw_only=True, eq=False)
class ImpactLog:
    """Measurements of one impact or several, along their normal.

    Attributes
    ----------
    time : (k,) [s], increasing.
    force : (k,) [N] on the target, positive in contact.
    speed : (k,) [m/s] of the striking point, positive towards the target; or None.
    travel : (k,) [m] of the striking point, instead of its speed; or None.
    model_mass : (k,) [kg] effective mass by the robot's model, if the log has joint positions.
    name : of the log, for messages.

    Raises
    ------
    InputError : columns of different lengths, or with NaN; time that does not increase; neither speed nor
        travel, or both.
    """

    time: Array = field(repr=False)
    force: Array = field(repr=False)
    speed: Array | None = field(default=None, repr=False)
    travel: Array | None = field(default=None, repr=False)
    model_mass: Array | None = field(default=None, repr=False)
    name: str = "log"

    def __post_init__(self) -> None:
        time = check_array(f"{self.name}: {TIME}", self.time, (None,), most=MOST)
        if not len(time):
            raise InputError(f"{self.name} is empty; give a row for each instant")
        back = np.flatnonzero(np.diff(time) <= 0)
        if back.size:
            k = int(back[0])
            raise InputError(
                f"{self.name}: {TIME} does not increase: {time[k]:.9g} s at row {k}, and {time[k + 1]:.9g} s "
                f"at row {k + 1}; sort the rows, and remove duplicates"
            )
        object.__setattr__(self, "time", time)
        if (self.speed is None) == (self.travel is None):
            raise InputError(f"{self.name}: give the speed of the hand or its travel, one of them")
        for name, key in (
            ("force", FORCE),
            ("speed", SPEED),
            ("travel", "travel [m]"),
            ("model_mass", "model_mass [kg]"),
        ):
            value = getattr(self, name)
            if value is not None:
                checked = check_array(f"{self.name}: {key}", value, (len(time),), most=MOST)
                object.__setattr__(self, name, checked)


def read_log(
    path: str | os.PathLike[str],
    *,
    robot: Robot | None = None,
    striker: str = "",
    normal: ArrayLike | None = None,
) -> ImpactLog:
    """Reads a log from a CSV file with a header, or from the arrays of an npz file.

    Columns are `time_s`, `force_N`, and `hand_speed_m_s`. Instead of the last there may be all joint
    positions of a robot on a fixed base, `<joint>_rad` (`<joint>_m` of a sliding one), from which `robot`,
    `striker` and `normal` give the motion of the hand; with a robot the speed is not read. Other columns are
    ignored.

    Raises
    ------
    InputError : a missing file, or one of another format; columns that are missing or no numbers; joint
        positions without a robot, or that look like degrees; as in `ImpactLog`.
    """
    file = Path(path)
    name = shortened(str(file))
    columns = _npz(file, name) if file.suffix == ".npz" else _csv(file, name)
    time, force = (_column(columns, needed, name) for needed in (TIME, FORCE))
    if robot is None:
        if SPEED in columns:
            return ImpactLog(time=time, force=force, speed=_column(columns, SPEED, name), name=name)
        raise InputError(
            f"{name}: no column {SPEED}{did_you_mean(SPEED, columns)}; give it, or joint positions and the "
            f"robot they are of. It has {_listed(columns)}"
        )
    joints = _joint_columns(robot)
    if SPEED in columns and not any(joint in columns for joint in joints):
        raise InputError(
            f"{name} has {SPEED}, and no joint positions: leave robot (--problem) out, or give the columns "
            f"{', '.join(joints)}"
        )
    travel, mass = _hand(columns, robot, striker, normal, name)
    return ImpactLog(time=time, force=force, travel=travel, model_mass=mass, name=name)


# ---------------------------------------------------------------- files
# the error is of a column with a cell that is no number, and raised if the column is needed
Columns = Mapping[str, Array | InputError]


def _csv(file: Path, name: str) -> Columns:
    """Columns of a CSV file, by their headings."""
    try:
        with open(file, newline="", encoding="utf-8-sig") as text:
            reader = csv.reader(text)
            rows = [(reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{name}: no CSV file ({error}); give one, or an .npz file") from None
    if not rows:
        raise InputError(f"{name} is empty; give {TIME}, {FORCE}, {SPEED} as a header, and a row an instant")
    header = [cell.strip() for cell in rows[0][1]]
    if len(header) == 1 and (other := next((s for s in (";", "\t") if s in header[0]), "")):
        raise InputError(
            f"{name}: its cells are separated by {other!r}; separate them by commas, with decimal points"
        )
    twice = [cell for cell in header if cell and header.count(cell) > 1]
    if twice:
        raise InputError(f"{name}: two columns are called {twice[0]!r}; rename one of them")
    if len(rows) < 2:
        raise InputError(f"{name} has a header and no rows; give a row for each instant")
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(f"{name}, line {line}: {len(row)} cells under {len(header)} headings")
    cells = {
        heading: [(line, row[k]) for line, row in rows[1:]] for k, heading in enumerate(header) if heading
    }
    return {heading: _numbers(column, f"{name}: {heading}") for heading, column in cells.items()}


def _numbers(cells: list[tuple[int, str]], where: str) -> Array | InputError:
    """Numbers of a column's cells, which are given with their lines."""
    out = np.empty(len(cells))
    for k, (line, cell) in enumerate(cells):
        try:
            out[k] = float(cell)
        except ValueError:
            return InputError(f"{where}: {shortened(repr(cell))} in line {line}; give a number")
    return out


def _npz(file: Path, name: str) -> Columns:
    """Arrays of an npz file, by name."""
    try:
        with np.load(read_archive(file, MAX_BYTES, MAX_ARRAYS), allow_pickle=False) as arrays:
            found = {key: arrays[key] for key in arrays.files}
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror or error}") from None
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{name}: no npz file of numbers ({error}); write one by np.savez") from None
    return found


def _column(columns: Columns, key: str, name: str) -> Array:
    if key not in columns:
        raise InputError(f"{name}: no column {key}{did_you_mean(key, columns)}; it has {_listed(columns)}")
    found = columns[key]
    if isinstance(found, InputError):
        raise found
    return found


def _listed(columns: Columns) -> str:
    return shortened(", ".join(columns), 200) or "none"


# ---------------------------------------------------------------- joint positions
def _hand(
    columns: Columns, robot: Robot, striker: str, normal: ArrayLike | None, name: str
) -> tuple[Array, Array]:
    """Travel (k,) [m] of the striking point along the normal, and effective mass (k,) [kg] there."""
    if robot.floating:
        raise InputError(
            f"{name}: joint positions do not determine the motion of {robot.name!r}'s hand, because its base "
            f"moves too; give the column {SPEED}"
        )
    if normal is None:
        raise InputError(f"{name}: joint positions need the normal of the impact: give normal=[x, y, z]")
    n, frame = check_direction("normal", normal), robot.striker(striker).model_frame
    model, data = robot.model, robot.model.createData()
    angles = np.column_stack([_joint(columns, robot, k, name) for k in range(robot.n)])
    travel, mass = np.empty((2, len(angles)))
    for k, q in enumerate(robot.angles.put(np.empty((len(angles), robot.nq)), angles)):
        pin.framesForwardKinematics(model, data, q)
        travel[k] = n @ data.oMf[model.getFrameId(frame)].translation
        mass[k] = 1.0 / (n @ ConstrainedDynamics.at(model, q, (), frame).inverse_mass() @ n)
    return travel, mass


def _joint_columns(robot: Robot) -> list[str]:
    """Columns of all joints' positions."""
    units = ("m" if sliding else "rad" for sliding in robot.prismatic)
    return [f"{joint}_{unit}" for joint, unit in zip(robot.joint_names, units, strict=True)]


def _joint(columns: Columns, robot: Robot, k: int, name: str) -> Array:
    """Positions (k,) [rad] or [m] of a joint, by its number."""
    joint = robot.joint_names[k]
    values = _column(columns, _joint_columns(robot)[k], name)
    low, high = robot.lower[k], robot.upper[k]
    values = check_array(f"{name}: {joint}", values, (np.size(_column(columns, TIME, name)),), most=MOST)
    far = np.maximum(values - high, low - values).max(initial=0.0)
    if not robot.prismatic[k] and far > _MAX_BEYOND:
        raise InputError(
            f"{name}: {joint} is {far:.3g} rad outside its limits, {low:.3g} to {high:.3g} rad; are these "
            "degrees? Multiply them by pi / 180"
        )
    return values


_MIN_CONTACT_FORCE, _MIN_PEAK = 0.1, 0.2  # of contact, and of an impact's peak, over the log's largest force
_MIN_REPORTED = 0.02  # of a weaker contact that is reported as left out, over the largest force
_MIN_SAMPLES = 8  # in contact
_MIN_CHANGES = 4  # of a value in contact, to tell if it is repeated
_MAX_GAP = 0.05  # without force in a contact, over its length: in a dense log that is many samples of noise
# A top is flat if at least so many samples in a row are within this fraction of the noise, or of the peak.
# A force that is cut off is constant to rounding; a round top of a dense log without noise is not.
_FLAT_SAMPLES, _NOISE_FRACTION, _PEAK_FRACTION = 4, 0.1, 1e-12
# Except for quantization: within half the length of a quantized top beyond its ends, a parabola falls by 3
# steps; a force that is cut off falls by more than so many.
_QUANTIZATION_STEPS = 6.0
_NOISE_STEPS = 30.0  # of the noise, over a converter's
# Samples of an impact between the first and the last within so many deviations of a cut are left out: at the
# top those with noise downward would be left only.
_NEAR_CUT = 3.0
_BEFORE, _AFTER = 0.5, 0.25  # fitted times before the touch and after the end, over the contact's duration
_RISE = 0.1  # time before the first sample in contact in which force may begin, over the contact's duration
_MIN_OFFSET_ERRORS, _MIN_OFFSET = 4.0, 5e-4  # of a force's offset, over its standard error and the peak
# limits beyond which other units are suspected
_MAX_DURATION, _MAX_SPEED, _MIN_MASS, _MAX_MASS = 1.0, 50.0, 1e-3, 1e4  # s, m/s, kg, kg


@dataclass(frozen=True, eq=False)
class MeasuredImpact:
    """Samples (k,) of one impact, with first estimates.

    time, force : [s], [N]
    motion, travels : travel [m] if travels, else speed [m/s]
    clipped : samples whose force was beyond the sensor's range
    touch : index of the first sample in contact
    duration, speed, mass : first estimates of contact time [s], speed at contact [m/s], and mass [kg]
    model_mass [kg] : effective mass by the robot's model, at the touch; nan if unknown
    """

    time: Array
    force: Array
    motion: Array
    clipped: Mask
    travels: bool
    touch: int
    duration: float
    speed: float
    mass: float
    model_mass: float

    @property
    def peak(self) -> float:
        """Largest force [N]."""
        return float(self.force.max())


def _clipped(force: Array, noise: float) -> Mask:
    """Mask (k,) of the samples of a log whose force is cut off: those at a flat top; noise : of the force."""
    top = float(force.max())
    at_top = force >= top - max(_NOISE_FRACTION * noise, _PEAK_FRACTION * top)
    step = float(np.diff(np.unique(force)).min(initial=np.inf))
    # noise that many steps of a converter are in leaves no equal samples at a top that is not cut off
    if np.sum(force >= top * (1 - _PEAK_FRACTION)) >= _FLAT_SAMPLES and noise > _NOISE_STEPS * step:
        return at_top
    for begin, end in np.flatnonzero(np.diff(np.concatenate([[0], at_top, [0]]))).reshape(-1, 2):
        beyond = (end - begin) // 2
        sides = [force[k] for k in (begin - 1 - beyond, end + beyond) if 0 <= k < len(force)]
        if end - begin >= _FLAT_SAMPLES and top - max(sides, default=-np.inf) > _QUANTIZATION_STEPS * step:
            return at_top
    return np.zeros(len(force), dtype=bool)


def noise_of(values: Array) -> float:
    """Standard deviation of white noise on values (k,) of a smooth history, from second differences.

    Those of white noise have sqrt(6) times its deviation. Their 80 % quantile, 1.2816 deviations, is robust
    against jumps and bends in a fifth of the samples.
    """
    if len(values) < 3:
        return 0.0
    return float(np.quantile(np.abs(np.diff(values, 2)), 0.8) / (1.2816 * np.sqrt(6)))


def find_impacts(log: ImpactLog) -> tuple[tuple[MeasuredImpact, ...], tuple[float, ...]]:
    """Finds the impacts in a log, and the times [s] of contacts that are too weak to be fitted.

    Raises
    ------
    InputError : no contact, a force of the wrong sign, too few samples, a log that begins or ends in contact,
        a hand that does not approach; values that look like other units.
    """
    peak, name = float(log.force.max()), log.name
    noise = noise_of(log.force)
    if -log.force.min() > max(peak, 8 * noise, 0.0):
        raise InputError(
            f"{name}: {FORCE} goes down to {log.force.min():.4g} N, and up to {peak:.4g} N only; the "
            "force on the target is positive in contact: turn its sign"
        )
    # Noise is as far below zero as above it, unlike an impact. The median is no such level: contact may fill
    # most of a log.
    if peak <= 0 or peak < max(6 * noise, -2 * float(log.force.min())):
        raise InputError(f"{name}: no contact: {FORCE} is at most {peak:.4g} N, as large as its noise")
    spans = _spans(log.force, max(_MIN_CONTACT_FORCE * peak, 4.5 * noise))
    spans = [span for span in spans if log.force[slice(*span)].max() > _MIN_PEAK * peak]
    # noise alone lifts a few samples of a long log, or of the end of a contact, above that
    loud = [(b, e) for b, e in spans if e - b >= _MIN_SAMPLES or log.force[b:e].max() > 8 * noise]
    spans = loud or spans
    clipped = _clipped(log.force, noise)
    weak = tuple(
        float(log.time[begin])
        for begin, end in _spans(log.force, max(_MIN_REPORTED * peak, 8 * noise))
        if log.force[begin:end].max() <= _MIN_PEAK * peak and end - begin >= _MIN_SAMPLES
    )
    return tuple(_impact(log, span, spans, noise, clipped) for span in spans), weak


def force_offset(impacts: Sequence[MeasuredImpact]) -> float:
    """Mean force [N] before the touches; 0 if it may be noise, or is negligible."""
    early = [i.force[i.time < i.time[i.touch] - _RISE * i.duration] for i in impacts]
    force = np.concatenate(early)
    if len(force) < _MIN_SAMPLES:
        return 0.0
    mean, error = float(force.mean()), float(force.std(ddof=1)) / np.sqrt(len(force))
    least = max(_MIN_OFFSET_ERRORS * error, _MIN_OFFSET * max(impact.peak for impact in impacts))
    return mean if abs(mean) > least else 0.0


def _spans(force: Array, least: float) -> list[tuple[int, int]]:
    """Spans (begin, end) of samples above a force [N]; short gaps, and gaps with force, are noise."""
    inside = force > least
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    spans: list[tuple[int, int]] = [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
    for _ in range(2):  # joined pieces are longer
        pieces, spans = spans, []
        for begin, end in pieces:
            first, last = spans[-1] if spans else (0, 0)
            gap = force[last:begin]
            short = max(2.0, _MAX_GAP * max(last - first, end - begin))
            if spans and (len(gap) <= short or gap.mean() > least / 2):
                spans[-1] = (first, end)
            else:
                spans.append((begin, end))
    return spans


def _impact(
    log: ImpactLog,
    span: tuple[int, int],
    spans: list[tuple[int, int]],
    noise: float,
    clipped: Mask,
) -> MeasuredImpact:
    """Impact from the span of its samples, and all spans of the log.

    Raises
    ------
    InputError : as in `find_impacts`.
    """
    (begin, end), t, f, name = span, log.time, log.force, log.name
    quiet = max(2 * noise, 1e-3 * float(f[begin:end].max()))
    before = max((e for _, e in spans if e <= begin), default=0)
    after = min((b for b, _ in spans if b >= end), default=len(t))
    # extend the span to samples with little force, up to the neighbouring impacts
    while begin > before and f[begin - 1] > quiet:
        begin -= 1
    while end < after and f[end] > quiet:
        end += 1
    where = f"{name}, impact at {t[begin]:.6g} s"
    if begin == 0 or end == len(t):
        raise InputError(
            f"{where}: the log {'begins' if begin == 0 else 'ends'} in contact; it has to begin before the "
            "touch, and end after the hand has left; take an offset off the force first"
        )
    duration = float(t[end] - t[begin])
    if duration > _MAX_DURATION:
        raise InputError(
            f"{where}: the contact lasts {duration:.3g} s, too long for an impact; is {TIME} in milliseconds?"
        )
    if end - begin < _MIN_SAMPLES:
        raise InputError(
            f"{where}: {counted(end - begin, 'sample')} in contact; at least {_MIN_SAMPLES} are needed: "
            f"log at {1.5 * _MIN_SAMPLES / duration:.0f} Hz or more, or take them out if they are outliers"
        )
    if clipped[begin:end].any():
        near = begin + np.flatnonzero((clipped | (f > f.max() - _NEAR_CUT * noise))[begin:end])
        clipped = clipped.copy()
        clipped[near[0] : near[-1] + 1] = True
    motion = log.travel if log.speed is None else log.speed
    assert motion is not None
    for key, values in ((FORCE, f), (SPEED if log.travel is None else "the motion", motion)):
        if (times := _repeats(values[begin:end])) > 1:
            raise InputError(
                f"{where}: each value of {key} is repeated some {times} times, as if it were sampled at a "
                "lower rate than the log: keep one row for each of its values"
            )
    low = int(np.searchsorted(t, t[begin] - _BEFORE * duration))
    high = int(np.searchsorted(t, t[end] + _AFTER * duration, side="right"))
    low, high = max(min(low, begin - 5), before, 0), min(max(high, end + 5), after, len(t))
    mean = _mean_slope if log.speed is None else _mean
    speed = mean(t[low:begin], motion[low:begin])
    if np.isnan(speed):
        raise InputError(
            f"{where}: the force has not returned to zero since the contact before it; take both "
            "contacts out of the log"
        )
    if not speed > 0:
        raise InputError(
            f"{where}: the hand moves at {speed:.3g} m/s before the touch; its speed towards the target is "
            "positive: turn its sign, or that of the normal"
        )
    if speed > _MAX_SPEED:
        raise InputError(f"{where}: the hand approaches at {speed:.4g} m/s; is {SPEED} in mm/s?")
    impulse = float(trapezoid(f[begin:end], t[begin:end]))
    lost = speed - mean(t[end:high], motion[end:high])
    # without a plausible loss of speed, assume a rebound with half the speed
    mass = impulse / (lost if lost > 0.2 * speed else 1.5 * speed)
    if not _MIN_MASS < mass < _MAX_MASS:
        raise InputError(
            f"{where}: an impulse of {impulse:.3g} N s slows the hand down by {max(lost, 0.0):.3g} of "
            f"{speed:.3g} m/s, as of a mass of {mass:.3g} kg; are all columns in s, N and m/s?"
        )
    return MeasuredImpact(
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


def _repeats(values: Array) -> int:
    """Number of rows with each value of a history, if a slower sensor has been held; else 1."""
    changes = np.diff(values)
    at = np.flatnonzero(changes)
    if len(at) < _MIN_CHANGES or np.quantile(np.diff(at), 0.1) < 2:
        return 1
    # a coarse converter repeats values too, and then changes by single steps
    sizes = np.abs(changes[at])
    return round(np.median(np.diff(at))) if np.median(sizes) > 1.5 * sizes.min() else 1


def _mean(time: Array, speed: Array) -> float:
    return float(speed.mean()) if len(speed) else np.nan


def _mean_slope(time: Array, travel: Array) -> float:
    return float(np.polyfit(time - time[0], travel, 1)[0]) if len(time) > 1 else np.nan
