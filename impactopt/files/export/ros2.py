"""ROS 2: goals of control_msgs/action/FollowJointTrajectory as YAML, for `ros2 action send_goal --stdin`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from impactopt.files.export.content import Export
from impactopt.files.export.motion import Motion


def write(export: Export, directory: Path) -> None:
    """`motion.yaml`, and `missed.yaml` of a plan with an abort motion."""
    for name, motion in export.motions.items():
        with open(directory / f"{name}.yaml", "w", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in _lines(export, motion))


def stamp(seconds: float) -> tuple[int, int]:
    """Whole seconds, and the rest in nanoseconds."""
    return divmod(round(1e9 * seconds), 1_000_000_000)


def _lines(export: Export, motion: Motion) -> Iterator[str]:
    meta = export.meta
    yield f"# {json.dumps(meta['problem'])} for {json.dumps(meta['robot'])}, {export.rate:g} Hz; SI units"
    yield f"# contact from {motion.contact_start:.9g} to {motion.contact_end:.9g} s; meta.json has the rest"
    # a JSON string is also a YAML string, whatever characters the names have
    yield "trajectory:"
    yield f"  joint_names: {json.dumps(list(export.joints))}"
    yield "  points:"
    for k, time in enumerate(motion.time):
        sec, nanosec = stamp(float(time))
        yield f"  - positions: {_numbers(motion.position[k])}"
        yield f"    velocities: {_numbers(motion.velocity[k])}"
        yield f"    accelerations: {_numbers(motion.acceleration[k])}"
        yield f"    effort: {_numbers(motion.effort[k])}"
        yield f"    time_from_start: {{sec: {sec}, nanosec: {nanosec}}}"


def _numbers(values: Any) -> str:
    """YAML list of numbers with decimal points: ROS accepts no integers for floats, and YAML takes 1e-05 for
    text.
    """
    texts = (repr(float(f"{x:.10g}")) for x in np.asarray(values))
    return f"[{', '.join(text if '.' in text else text.replace('e', '.0e') for text in texts)}]"
