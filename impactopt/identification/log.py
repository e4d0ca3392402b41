"""Logs of blows: their columns, from CSV or npz, and what can be wrong with them."""

from __future__ import annotations

import csv
import os
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from impactopt.codegen.files import read_archive
from impactopt.errors import MOST, InputError, check_array, check_direction, did_you_mean, shortened
from impactopt.kinematics.operational_space import Held
from impactopt.robots.robot import Robot

__all__ = ["FORCE", "SPEED", "TIME", "ImpactLog", "read_log"]

Array = NDArray[np.float64]
TIME, FORCE, SPEED = "time_s", "force_N", "hand_speed_m_s"
LARGEST, COLUMNS = 1 << 29, 1000  # bytes and arrays of an npz file: an hour at 1 kHz of 15 columns has 430 MB
_BEYOND = 2 * np.pi  # [rad] outside its limits, of a joint that is no longer believed to be in radians


@dataclass(frozen=True, kw_only=True, eq=False)
class ImpactLog:
    """Measurements of one blow or several, all along the normal of the blow.

    Attributes
    ----------
    time : (k,) [s], increasing.
    force : (k,) [N] on the target, which the blow pushes: positive.
    speed : (k,) [m/s] of the striking point, towards the target: positive; or None.
    travel : (k,) [m] of the striking point, in the place of its speed; or None.
    model_mass : (k,) [kg] effective mass by the robot's model, where the log has joint positions.
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
                f"at row {k + 1}; sort the rows, and take out those that stand twice"
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
    """A log from a CSV file with a header, or from the arrays of an npz file.

    Columns are `time_s`, `force_N`, and `hand_speed_m_s`. In the place of the last there may be all joint
    positions of a robot on a fixed base, `<joint>_rad` (`<joint>_m` of a sliding one); then `robot`,
    `striker` and `normal` say where the hand is. Other columns are not read.

    Raises
    ------
    InputError : no such file, or one that is neither; columns that are missing or no numbers; joint positions
        without a robot, or that look like degrees; as of `ImpactLog`.
    """
    file = Path(path)
    name = shortened(str(file))
    columns = _npz(file, name) if file.suffix == ".npz" else _csv(file, name)
    for needed in (TIME, FORCE):
        _column(columns, needed, name)
    time, force = columns[TIME], columns[FORCE]
    if SPEED in columns:
        return ImpactLog(time=time, force=force, speed=columns[SPEED], name=name)
    if robot is None:
        raise InputError(
            f"{name}: no column {SPEED}{did_you_mean(SPEED, columns)}; give it, or joint positions and the "
            f"robot they are of. It has {_listed(columns)}"
        )
    travel, mass = _hand(columns, robot, striker, normal, name)
    return ImpactLog(time=time, force=force, travel=travel, model_mass=mass, name=name)


# ---------------------------------------------------------------- files
def _csv(file: Path, name: str) -> dict[str, Array]:
    try:
        with open(file, newline="", encoding="utf-8-sig") as text:
            rows = [row for row in csv.reader(text) if row]
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{name}: no CSV file ({error}); give one, or an .npz file") from None
    if not rows:
        raise InputError(f"{name} is empty; give {TIME}, {FORCE}, {SPEED} as a header, and a row an instant")
    header = [cell.strip() for cell in rows[0]]
    twice = [cell for cell in header if cell and header.count(cell) > 1]
    if twice:
        raise InputError(f"{name}: two columns are called {twice[0]!r}; rename one of them")
    if len(rows) < 2:
        raise InputError(f"{name} has a header and no rows; give a row for each instant")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise InputError(f"{name}, row {number}: {len(row)} cells under {len(header)} headings")
    return {heading: _numbers([row[k] for row in rows[1:]]) for k, heading in enumerate(header) if heading}


def _numbers(cells: list[str]) -> Array:
    """Numbers of a column; other text becomes NaN, which is refused in columns that are needed."""
    out = np.empty(len(cells))
    for k, cell in enumerate(cells):
        try:
            out[k] = float(cell)
        except ValueError:
            out[k] = np.nan
    return out


def _npz(file: Path, name: str) -> dict[str, Array]:
    try:
        with np.load(read_archive(file, LARGEST, COLUMNS), allow_pickle=False) as arrays:
            found = {key: arrays[key] for key in arrays.files}
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror or error}") from None
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{name}: no npz file of numbers ({error}); write one by np.savez") from None
    return found


def _column(columns: Mapping[str, Array], key: str, name: str) -> Array:
    if key not in columns:
        raise InputError(f"{name}: no column {key}{did_you_mean(key, columns)}; it has {_listed(columns)}")
    return columns[key]


def _listed(columns: Mapping[str, Array]) -> str:
    return shortened(", ".join(columns), 200) or "none"


# ---------------------------------------------------------------- joint positions
def _hand(
    columns: Mapping[str, Array], robot: Robot, striker: str, normal: ArrayLike | None, name: str
) -> tuple[Array, Array]:
    """Travel (k,) [m] of the striking point along the normal, and effective mass (k,) [kg] there."""
    if robot.floating:
        raise InputError(
            f"{name}: joint positions do not say where the hand of {robot.name!r} is, whose base moves too; "
            f"give the column {SPEED}"
        )
    if normal is None:
        raise InputError(f"{name}: joint positions need the normal of the blow: give normal=[x, y, z]")
    n, frame = check_direction("normal", normal), robot.striker(striker).model_frame
    model, data = robot.model, robot.model.createData()
    angles = np.column_stack([_joint(columns, robot, k, name) for k in range(robot.n)])
    travel, mass = np.empty(len(angles)), np.empty(len(angles))
    for k, q in enumerate(_configurations(robot, angles)):
        pin.framesForwardKinematics(model, data, q)
        travel[k] = n @ data.oMf[model.getFrameId(frame)].translation
        mass[k] = 1.0 / (n @ Held.at(model, q, (), frame).inverse_mass() @ n)
    return travel, mass


def _joint(columns: Mapping[str, Array], robot: Robot, k: int, name: str) -> Array:
    joint, slides = robot.joint_names[k], not _turns(robot, k)
    values = _column(columns, f"{joint}_{'m' if slides else 'rad'}", name)
    low, high = robot.lower[k], robot.upper[k]
    values = check_array(f"{name}: {joint}", values, (None,))
    far = np.maximum(values - high, low - values).max(initial=0.0)
    if not slides and far > _BEYOND:
        raise InputError(
            f"{name}: {joint} is {far:.3g} rad outside its limits, {low:.3g} to {high:.3g} rad; are these "
            "degrees? Multiply them by pi / 180"
        )
    return values


def _turns(robot: Robot, k: int) -> bool:
    joint = list(robot.model.joints)[-robot.n :][k]
    data = joint.createData()
    joint.calc(data, pin.neutral(robot.model))
    return bool(np.any(np.asarray(data.S).reshape(6)[3:]))


def _configurations(robot: Robot, angles: Array) -> Array:
    """(k, nq) of joint positions (k, n): a continuous joint is (cosine, sine) there."""
    out = np.empty((len(angles), robot.nq))
    for joint, values in zip(list(robot.model.joints)[-robot.n :], angles.T, strict=True):
        if joint.nq == 2:
            out[:, joint.idx_q], out[:, joint.idx_q + 1] = np.cos(values), np.sin(values)
        else:
            out[:, joint.idx_q] = values
    return out
