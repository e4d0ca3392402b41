"""The bench of robots: motions to random targets, with which a drafted one is compared."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import robots
from impactopt.errors import InputError
from impactopt.files.problem_file import load_problem
from impactopt.kinematics.operational_space import striking_point
from impactopt.problem.problem import ImpactProblem
from impactopt.solvers.program import Status


def test_a_random_target_has_a_start_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind the target; and one without a motion makes room for another."""
    problem, planned = load_problem("arm_planar"), list[ImpactProblem]()

    def solved(one: ImpactProblem, **options: Any) -> SimpleNamespace:
        planned.append(one)
        if len(planned) == 1:
            raise InputError("no motion")
        return SimpleNamespace(impulse=float(len(planned)), status=Status.SOLVED)

    monkeypatch.setattr(robots, "solve", solved)
    monkeypatch.setattr(robots, "PLANNED", 3)
    found = robots.motions_to_random(problem, np.random.default_rng(0), 10)
    assert found == [2.0, 3.0, 4.0]
    starts = [one.robot.joint_positions(one.start_posture) for one in planned]
    assert len(np.unique(np.round(starts, 3), axis=0)) == len(planned) == 4
    for one in planned:
        at = striking_point(one.robot, one.striker, one.start_posture)
        assert one.normal @ (one.point - at) >= robots.BEHIND
        assert one.point[0] > robots.FRONT


def test_ci_s_robots_leave_the_rows_of_the_bench_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row whose file has moved is refused in no time, which is a failure."""
    monkeypatch.chdir(tmp_path)
    robots.ROWS.parent.mkdir(parents=True)
    robots.ROWS.write_text("half an hour\n")
    monkeypatch.setitem(robots.ROBOTS, "gone", "gone.urdf")
    monkeypatch.setattr(sys, "argv", ["check_robots.py", "gone"])
    with pytest.raises(SystemExit, match="1"):
        runpy.run_path(str(Path(__file__).parents[2] / ".ci" / "check_robots.py"))
    assert robots.ROWS.read_text() == "half an hour\n"
