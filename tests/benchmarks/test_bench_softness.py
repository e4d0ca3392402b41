"""What soft grips and gains bring: rows by factor, what the plan chooses, and the picture."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.planning import DEMO
from benchmarks.registry import run_bench
from impactopt import InputError

SOFT = """
[robot]
preset = "planar_arm"
[robot.grips.hammer]
axis = [0.0, 1.0, 0.0]
point_m = [0.0, 0.0, 0.08]
stiffness_N_m_rad = 20.0
damping_N_m_s_rad = 0.5
[[robot.gains]]
joints = ["wrist"]
factor = [0.1, 10.0]
"""


@pytest.mark.slow
def test_a_row_a_factor_and_one_with_what_is_chosen(tmp_path: Path) -> None:
    """What a file leaves open itself is not: the bench asks about the grip alone."""
    text = (DEMO.parent / "arm_planar.toml").read_text().replace('robot = "planar_arm"\n', "")
    (tmp_path / "soft.toml").write_text(text + SOFT)
    report = run_bench("softness", lambda _: None, problems=[str(tmp_path / "soft.toml")], factors=[4, 0.3])
    rows = report.numbers["rows"]
    assert [row["chosen"] for row in rows] == [False, False, True]
    assert [row["factor"] for row in rows[:2]] == [0.3, 4.0]
    for row in rows:
        assert row["status"] == "solved"
        assert row["stiffness_N_m_rad"] == pytest.approx(20.0 * row["factor"])
        assert row["gear_replayed"] == pytest.approx(row["gear_planned"], rel=0.05)
    assert rows[2]["energy_J"] > max(row["energy_J"] for row in rows[:2])
    impulse, depth, gear = report.figures["softness"]().axes
    assert list(impulse.lines[0].get_ydata()) == [row["impulse_Ns"] for row in rows[:2]]
    (line, star) = depth.lines
    assert list(line.get_xdata()) == [0.3, 4.0] and list(star.get_xdata()) == [rows[2]["factor"]]
    assert star.get_ydata()[0] == pytest.approx(1e3 * rows[2]["target"])
    assert list(gear.lines[0].get_ydata()) == [row["gear_planned"] for row in rows[:2]]
    json.dumps(rows)


@pytest.mark.parametrize("factors", [[1.0], [2.0, 2.0], [-1.0, 1.0]])
def test_factors_that_leave_no_choice_are_refused(factors: list[float]) -> None:
    with pytest.raises(InputError, match="at least two"):
        run_bench("softness", lambda _: None, factors=factors)


def test_a_joint_that_there_is_not_is_refused() -> None:
    with pytest.raises(InputError, match="no joint is called 'finger'"):
        run_bench("softness", lambda _: None, problems=["arm7"], joints=["finger"])
