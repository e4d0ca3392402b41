"""Plans that leave the house: files that other programs read, one writer a file.

A new format is a file here with a function `write(export, directory)`, and a line in FORMATS.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from impactopt.errors import InputError, check_choice
from impactopt.files.export.content import check_export, export_of, write_directory
from impactopt.files.output import record_of
from impactopt.files.replay import Planned
from impactopt.planning.solution import Solution

__all__ = ["FORMATS", "Format", "export", "export_planned"]


@dataclass(frozen=True, kw_only=True)
class Format:
    """module : of this package that writes it.  rate [Hz] : usual.  whole : effort is all that moves it."""

    module: str
    rate: float = 1000.0
    whole: bool = False


FORMATS: Mapping[str, Format] = {
    "csv": Format(module="csv_files"),
    "ros2": Format(module="ros2"),
    "mcap": Format(module="mcap_file"),
    "mujoco": Format(module="mujoco_scene", whole=True),
    "mjlab": Format(module="mjlab", rate=50.0, whole=True),  # policies act at 50 Hz, a frame each time
}


def export(
    solution: Solution,
    to: str,
    directory: str | os.PathLike[str],
    *,
    rate: float | None = None,
    joints: Sequence[str] | None = None,
    gravity: bool = True,
    smooth: tuple[float, float] | None = None,
) -> list[Path]:
    """Write a plan for other programs; the files.

    to : "csv", "ros2", "mcap", "mujoco" or "mjlab".
    directory : is made; an earlier export to the same format in it is replaced.
    rate [Hz] : of its rows; 1000, for mjlab 50.
    joints : their order in all columns, each of the robot's once; the robot's own if left out.
    gravity : False: effort is without the torque that holds the posture against gravity, for arms whose
        controller adds that itself.
    smooth : largest acceleration [rad/s^2] and jerk [rad/s^3] of all joints, for bolted arms whose
        controllers refuse jumps: the nearest motion within these. ``meta.json`` says what it costs.

    Raises
    ------
    InputError : an unknown format, a plan that is not finished, joints that are no order of the robot's, a
        directory with something else in it, a package that is missing; a robot on soles, or a format that
        needs the whole effort, without gravity; a robot on soles, or limits that no motion is within,
        smoothed. Nothing is written then.
    """
    check_choice("there is no format", to, FORMATS)
    usual = FORMATS[to].rate
    # before the record's numbers are computed
    check_export(solution.status.value, solution.problem.robot, usual if rate is None else rate, joints)
    record = record_of(solution)
    if not record.completed:
        raise InputError(f"there is no motion to export: {record.summary['note']}")
    missed = solution.missed_trajectory if solution.plan.abort is not None else None
    planned = Planned(record=record, problem=solution.problem, reference=solution.trajectory, missed=missed)
    return export_planned(planned, to, directory, rate=rate, joints=joints, gravity=gravity, smooth=smooth)


def export_planned(
    planned: Planned,
    to: str,
    directory: str | os.PathLike[str],
    *,
    rate: float | None = None,
    joints: Sequence[str] | None = None,
    gravity: bool = True,
    smooth: tuple[float, float] | None = None,
) -> list[Path]:
    """The same of a plan that was read from a disk."""
    check_choice("there is no format", to, FORMATS)
    chosen = FORMATS[to]
    if chosen.whole and not gravity:
        raise InputError(f"gravity: {to} needs the whole effort; leave gravity at its default")
    rate = chosen.rate if rate is None else rate
    content = export_of(planned, rate=rate, joints=joints, gravity=gravity, smooth=smooth)
    writer = importlib.import_module(f"impactopt.files.export.{chosen.module}")
    return write_directory(Path(directory), to, content.meta, lambda new: writer.write(content, new))
