"""A series of blows on a nail: each where the one before has left it, until it is in."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.small_robots import arm, striking_point
from typer.testing import CliRunner

from impactopt import (
    FixedBase,
    FreeMass,
    ImpactProblem,
    InputError,
    KelvinVoigt,
    Nail,
    Solution,
    Status,
)
from impactopt.cli.app import app
from impactopt.files.problem_file import ProblemFile
from impactopt.planning import nail_driving as blows
from impactopt.planning.nail_driving import Blow, Series, drive_nail

NAIL = Nail(mass=0.05, resistance=1000.0, hardening=2e4, depth=0.01)
WORK = 10.0  # [J] of each made-up blow


def nailing(**changes: Any) -> ImpactProblem:
    robot = arm()
    given: dict[str, Any] = {
        "robot": robot,
        "striker": "hand",
        "start": "start",
        "stance": FixedBase(),
        "point": striking_point(robot, "start", "hand") + np.array([0.05, 0.05, 0.1]),
        "normal": [0.0, 1.0, 0.0],
        "law": KelvinVoigt(stiffness=1e5, damping=100.0),
        "target": NAIL,
    }
    return ImpactProblem(**{**given, **changes})


def driven(nail: Nail) -> float:
    """[m] by WORK against the wood: R s + hardening s^2 / 2 = WORK."""
    R, h = nail.resistance + nail.hardening * nail.depth, nail.hardening
    return float((-R + np.sqrt(R**2 + 2 * h * WORK)) / h)


class Solver:
    """Blows of WORK; what it was asked for."""

    def __init__(
        self,
        *,
        fails_at: tuple[int, ...] = (),
        drives: Callable[[Nail], float] = driven,
        fails: Status = Status.INFEASIBLE,
    ) -> None:
        self.asked: list[tuple[ImpactProblem, Any, dict[str, Any]]] = []
        self.fails_at, self.drives, self.fails = fails_at, drives, fails

    def __call__(self, problem: ImpactProblem, *, start: Any, **options: Any) -> Any:
        self.asked.append((problem, start, options))
        k = len(self.asked)
        assert isinstance(problem.target, Nail)
        collision = SimpleNamespace(outcome={"depth_m": self.drives(problem.target)}, peak_force=900.0)
        return SimpleNamespace(
            problem=problem,
            status=self.fails if k in self.fails_at else Status.SOLVED,
            plan=SimpleNamespace(collision=collision, hand_speed=3.0),
            collision=collision,
            result=SimpleNamespace(x=np.full(4, float(k)), iterations=7, message="no way"),
            impulse=5.0,
            solve_seconds=0.5,
        )


@pytest.fixture
def solver(monkeypatch: pytest.MonkeyPatch) -> Solver:
    solver = Solver()
    monkeypatch.setattr(blows, "solve", solver)
    return solver


def test_each_blow_is_planned_where_the_one_before_left_the_nail(solver: Solver) -> None:
    problem = nailing()
    series = drive_nail(problem, depth=0.04, time_limit=9.0)
    assert series.done and series.reason == ""
    # depth by energy: n blows do n WORK in all
    first = NAIL.resistance * NAIL.depth + NAIL.hardening * NAIL.depth**2 / 2
    for k, blow in enumerate(series.blows, start=1):
        R, h = NAIL.resistance, NAIL.hardening
        deep = (-R + np.sqrt(R**2 + 2 * h * (first + k * WORK))) / h
        assert blow.depth == pytest.approx(deep, rel=1e-12)
        asked, start, options = solver.asked[k - 1]
        assert isinstance(asked.target, Nail)
        before = NAIL.depth if k == 1 else series.blows[k - 2].depth
        assert asked.target.depth == before and blow.driven == pytest.approx(blow.depth - before)
        np.testing.assert_allclose(
            asked.point, problem.point + (before - NAIL.depth) * problem.normal, atol=1e-15
        )
        assert (start == "reach") if k == 1 else (start.result.x[0] == k - 1)
        assert options == {"time_limit": 9.0, "report": None}
    assert series.blows[-2].depth < 0.04 <= series.blows[-1].depth


@pytest.mark.parametrize(
    ("made", "options", "blows_made", "reason"),
    [
        (Solver(fails_at=(3, 4)), {}, 2, "blow 3 has no plan: no way"),
        (Solver(), {"most": 2}, 2, "the nail is not in yet at 24.8 mm"),
        (Solver(drives=lambda nail: 5e-5), {}, 1, "the nail moves no more at 10.1 mm"),
    ],
)
def test_a_series_that_ends_early_says_why(
    monkeypatch: pytest.MonkeyPatch, made: Solver, options: dict[str, Any], blows_made: int, reason: str
) -> None:
    monkeypatch.setattr(blows, "solve", made)
    said: list[str] = []
    series = drive_nail(nailing(), depth=0.05, report=said.append, **options)
    assert not series.done and series.reason == reason
    assert len(series.blows) == blows_made and len(said) == blows_made
    assert said[0].startswith("blow 1: ")


def test_a_plan_that_leads_nowhere_is_not_where_the_next_one_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    made = Solver(fails_at=(2,))
    monkeypatch.setattr(blows, "solve", made)
    assert len(drive_nail(nailing(), depth=0.03).blows) == 3
    assert [s if isinstance(s, str) else s.result.x[0] for _, s, _ in made.asked] == ["reach", 1, "reach", 3]


def test_a_blow_from_the_plan_before_has_one_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """`solve` refuses several from a given one; the reach after a failure has them again."""
    made = Solver(fails_at=(2,))
    monkeypatch.setattr(blows, "solve", made)
    drive_nail(nailing(), depth=0.03, starts=3)
    assert [options.get("starts", 1) for _, _, options in made.asked] == [3, 1, 3, 1]


def test_a_nail_that_is_in_on_the_last_step_is_in(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blows, "solve", Solver(drives=lambda nail: 5e-5))
    assert drive_nail(nailing(), depth=0.01 + 4e-5).done


def test_a_blow_has_the_peak_force_of_its_solutions_summary(hammered: Solution) -> None:
    """That of the finer mesh, as of `impactopt solve`, not that of the program's points."""
    series = Series(blows=(Blow(solution=hammered, depth=0.007),), reason="")
    peak = series.describe()["blows"][0]["peak_force_N"]
    assert peak == hammered.summary()["peak_force_N"] != hammered.plan.collision.peak_force


def test_what_cannot_be_driven_is_refused(solver: Solver) -> None:
    with pytest.raises(InputError, match="target is a FreeMass"):
        drive_nail(nailing(target=FreeMass(mass=1.0)), depth=0.05)
    with pytest.raises(InputError, match=r"0\.01 m deep already"):
        drive_nail(nailing(), depth=0.01)
    with pytest.raises(InputError, match="depth"):
        drive_nail(nailing(), depth=float("nan"))
    with pytest.raises(InputError, match="most: 0; give a whole number"):
        drive_nail(nailing(), depth=0.05, most=0)
    assert not solver.asked


def test_the_command_drives_the_nail_in(
    solver: Solver, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(ProblemFile, "build", lambda self: nailing())
    base = ["drive", "arm_planar", "--depth", "0.03", "--quiet"]
    table = CliRunner().invoke(app, [*base, "--out", str(tmp_path)])
    assert table.exit_code == 0, table.output
    assert "the nail is in after 3 blows" in table.output and "7.8" in table.output
    kept = json.loads((tmp_path / "blows.json").read_text(encoding="utf-8"))
    as_json = CliRunner().invoke(app, [*base, "--json"])
    assert json.loads(as_json.stdout) == {"ok": True, **kept} and kept["done"]
    assert [round(1e3 * blow["driven_m"], 1) for blow in kept["blows"]] == [7.8, 7.0, 6.4]
    early = CliRunner().invoke(app, [*base, "--most", "1"])
    assert early.exit_code == 1 and "the nail is not in yet" in early.output


def test_a_series_that_is_stopped_solves_no_more(solver: Solver) -> None:
    solver.fails_at, solver.fails = (2,), Status.INTERRUPTED
    series = drive_nail(nailing(), depth=0.05)
    assert len(solver.asked) == 2
    assert len(series.blows) == 1 and series.reason == "blow 2 has no plan: no way"
