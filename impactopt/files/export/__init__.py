"""Export of plans to files for other programs; one module per format.

A new format is a module here with a function `write(export, directory)`, and a line in FORMATS.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from impactopt.errors import InputError, check_choice, check_kind
from impactopt.files.export.content import check_export, export_of, write_directory
from impactopt.files.output import record_of
from impactopt.files.replay import Planned
from impactopt.planning.solution import Solution

__all__ = ["FORMATS", "Format", "export", "export_planned"]


@dataclass(frozen=True, kw_only=True)
class Format:
    """Export format.

    module : of this package, with its writer.  rate [Hz] : default.  needs_gravity : its reader does not
    compensate gravity, so effort must include it.
    """

    module: str
    rate: float = 1000.0
    needs_gravity: bool = False


FORMATS: Mapping[str, Format] = {
    "csv": Format(module="csv_files"),
    "ros2": Format(module="ros2"),
    "mcap": Format(module="mcap_file"),
    "mujoco": Format(module="mujoco_scene", needs_gravity=True),
    # policies act at 50 Hz, on one frame each
    "mjlab": Format(module="mjlab", rate=50.0, needs_gravity=True),
}


def export(
    solution: Solution,
    to: str,
    directory: str | os.PathLike[str],
    *,
    rate: float | None = None,
    joints: Sequence[str] | None = None,
    gravity: bool = True,
    smooth: Literal["terms"] | tuple[float, float] | None = None,
) -> list[Path]:
    """Write a plan for other programs; the paths of the files.

    to : "csv", "ros2", "mcap", "mujoco" or "mjlab".
    directory : is made; an earlier export to the same format in it is replaced.
    rate [Hz] : of the samples; default 1000, for mjlab 50.
    joints : order of all joints in the columns; default the robot's own.
    gravity : False: effort without the torque that balances gravity, for arms whose controller adds it.
    smooth : largest acceleration [rad/s^2] and jerk [rad/s^3] of all joints, or "terms" for the limits of
        `JointAcceleration` and `JointJerk` in the problem, for bolted arms whose controllers refuse jumps:
        the nearest motion within these. ``meta.json`` has its impulse.

    Raises
    ------
    InputError : an unknown format, a plan that is not solved, joints that are no permutation of the robot's,
        a directory with other files, a missing package; a robot that is not bolted, without gravity or
        smoothed; a format that needs gravity, without; limits that no motion satisfies. Nothing is written
        then.
    """
    check_choice("there is no format", to, FORMATS)
    check_kind("solution", solution, Solution)
    default = FORMATS[to].rate
    # first, as computing the record takes time
    check_export(solution.status.value, solution.problem.robot, default if rate is None else rate, joints)
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
    smooth: Literal["terms"] | tuple[float, float] | None = None,
) -> list[Path]:
    """Export of a saved plan; arguments as of `export`."""
    check_choice("there is no format", to, FORMATS)
    chosen = FORMATS[to]
    if chosen.needs_gravity and not gravity:
        raise InputError(f"gravity: {to} needs the whole effort; leave gravity at its default")
    rate = chosen.rate if rate is None else rate
    content = export_of(planned, rate=rate, joints=joints, gravity=gravity, smooth=smooth)
    writer = importlib.import_module(f"impactopt.files.export.{chosen.module}")
    return write_directory(Path(directory), to, content.meta, lambda new: writer.write(content, new))
