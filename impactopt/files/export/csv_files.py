"""CSV: a table for each motion, whose header has names and units."""

from __future__ import annotations

import csv
from pathlib import Path

from impactopt.arrays import Array
from impactopt.files.export.content import Export
from impactopt.files.export.motion import Motion


def write(export: Export, directory: Path) -> None:
    """`motion.csv`, and `missed.csv` of a plan with an abort motion."""
    for name, motion in export.motions.items():
        columns = _columns(export, motion)
        with open(directory / f"{name}.csv", "w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(columns)
            for row in zip(*columns.values(), strict=True):
                table.writerow([f"{number:.12g}" for number in row])


def _columns(export: Export, motion: Motion) -> dict[str, Array]:
    """Columns (k,) by their headers."""
    inside = (motion.phase == 1).astype(float)
    phase = motion.phase.astype(float)
    out: dict[str, Array] = {"time [s]": motion.time, "phase": phase, "contact": inside}
    out |= {f"{name} stands": on.astype(float) for name, on in export.standing(motion).items()}
    kinds = [joint["kind"] == "prismatic" for joint in export.meta["joints"]]
    for what, values, turning, sliding in (
        ("position", motion.position, "rad", "m"),
        ("velocity", motion.velocity, "rad/s", "m/s"),
        ("acceleration", motion.acceleration, "rad/s^2", "m/s^2"),
        ("effort", motion.effort, "N m", "N"),
    ):
        for name, slides, column in zip(export.joints, kinds, values.T, strict=True):
            out[f"{what} {name} [{sliding if slides else turning}]"] = column
    if (base := motion.base) is not None:
        for what, values, axes, unit in (
            ("base position", base.position, "xyz", " [m]"),
            ("base quaternion", base.quaternion, "wxyz", ""),
            ("base linear velocity", base.linear, "xyz", " [m/s]"),
            ("base angular velocity", base.angular, "xyz", " [rad/s]"),
        ):
            out |= {f"{what} {axis}{unit}": column for axis, column in zip(axes, values.T, strict=True)}
    out["force [N]"] = motion.force
    if motion.zmp is not None:
        out |= {f"zmp {axis} [m]": column for axis, column in zip("xy", motion.zmp.T, strict=True)}
    return out
