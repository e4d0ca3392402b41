"""What gears cost a blow: rows, a limit that is too low, and the picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import machine
from benchmarks.planning import DEMO
from benchmarks.registry import run_bench
from impactopt import InputError
from impactopt.codegen.compiler import find_compiler

SOFT = """
[robot.grips.hammer]
axis = [0.0, 1.0, 0.0]
point_m = [0.0, 0.0, 0.08]
stiffness_N_m_rad = 20.0
damping_N_m_s_rad = 0.5
"""


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_a_row_a_limit(tmp_path: Path) -> None:
    """Of an arm that holds its hammer firmly, and one that does so softly."""
    text = (DEMO.parent / "arm_planar.toml").read_text()
    (tmp_path / "firm.toml").write_text(text)
    soft = text.replace('robot = "planar_arm"\n', "")
    (tmp_path / "soft.toml").write_text(soft + '[robot]\npreset = "planar_arm"\n' + SOFT)
    said: list[str] = []
    files = [str(tmp_path / f"{name}.toml") for name in ("firm", "soft")]
    report = run_bench("machine", said.append, limits=(None, 1.8), problems=files)
    rows = report.numbers["rows"]
    assert [(row["problem"], row["gear_limit"]) for row in rows] == [
        (name, limit) for name in ("firm", "soft") for limit in (None, 1.8)
    ]
    keys = {"problem", "gear_limit", "impulse_Ns", "gear_planned", "gear_replayed", "joint", "seconds"}
    assert all({*keys, "stands"} <= row.keys() and row["status"] == "solved" for row in rows)
    for row in rows:
        assert row["gear_replayed"] == pytest.approx(row["gear_planned"], rel=0.05)
    free, kept, gentle, same = rows
    assert free["gear_planned"] > 1.8 * 1.03 > kept["gear_planned"] and kept["joint"] == "wrist"
    assert kept["impulse_Ns"] < free["impulse_Ns"]
    assert gentle["gear_planned"] < 1.0 and gentle["target"] > free["target"], "softly, and deeper"
    assert same["impulse_Ns"] == pytest.approx(gentle["impulse_Ns"], rel=0.1)
    one, other = report.figures["machine"]().axes[0].lines
    assert list(one.get_xdata()) == [1.8, 1.8 + 0.75] and list(one.get_ydata())[1] == 1.0
    assert other.get_label() == "soft"
    json.dumps(rows)


def test_a_plan_that_is_none_is_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any) -> None:
        raise InputError("the gear breaks")

    monkeypatch.setattr(machine, "solved", refused)
    monkeypatch.setattr(machine, "problem_names", lambda: ("nailing", "punch_infeasible"))
    report = run_bench("machine", lambda _: None, limits=(None, 1.0))
    told = {"problem": "nailing", "armature": 1.0, "status": "error", "error": "the gear breaks"}
    assert report.numbers["rows"] == [{**told, "gear_limit": None}, {**told, "gear_limit": 1.0}]
    assert not report.figures["machine"]().axes[0].lines


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_half_the_armature_spares_the_gear() -> None:
    """A rotor takes its share of the blow through the gear: half of it, less."""
    given: dict[str, Any] = {"problems": ["arm_planar"], "limits": ["none"], "armatures": [0.5, 1.0]}
    report = run_bench("machine", lambda _: None, **given)
    half, whole = report.numbers["rows"]
    assert (half["armature"], whole["armature"]) == (0.5, 1.0)
    assert half["gear_planned"] < whole["gear_planned"] and whole["gear_limit"] is None
    assert half["gear_replayed"] == pytest.approx(half["gear_planned"], rel=0.05)


@pytest.mark.parametrize(("name", "given"), [("limit", "some"), ("limit", -1.0), ("armature", 0.0)])
def test_a_limit_that_is_none(name: str, given: Any) -> None:
    with pytest.raises(InputError, match=f"{name} is {given!r}; give a number > 0"):
        run_bench("machine", lambda _: None, problems=["arm_planar"], **{f"{name}s": [given]})


def test_a_problem_that_there_is_not() -> None:
    with pytest.raises(InputError, match=r"no problem 'nail'.*did you mean 'nailing'"):
        run_bench("machine", lambda _: None, problems=["nail"])
