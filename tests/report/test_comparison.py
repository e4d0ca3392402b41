"""`impactopt compare`: numbers, differences, picture and page of several results. No solver is run."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.browser import Job, visit
from support.fake_solution import IMPULSE, PROBLEM_FILE, still_problem, still_solution, strike_record
from support.picture_checks import frowns
from support.small_robots import arm
from typer.testing import CliRunner

from impactopt import InputError
from impactopt.cli.app import app
from impactopt.files.output import record_of, save_record
from impactopt.files.record import Record
from impactopt.report.comparison import compare, histories_of
from impactopt.report.pictures.compare import comparison_picture
from impactopt.report.result_rows import result_rows, standing

runner = CliRunner()


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    """Two of a problem: another mass, another version, another impulse and force, one of them replayed."""
    solution = still_solution(problem=still_problem(name="stand <still> & wait"))
    one = record_of(solution, replay=solution.validate(engine="mujoco"), problem=PROBLEM_FILE)
    text = PROBLEM_FILE.replace("mass_kg = 5.0", "mass_kg = 8").replace("1e4", "10000")
    text += '[[scenarios]]\nname = "heavy"\nmass = 2.0\n'
    versions = {**one.summary["versions"], "casadi": "0.0.1"}
    summary = {
        **record_of(solution).summary,
        "impulse_Ns": 12.5,
        "versions": versions,
        "status": "time_limit",
    }
    arrays = {**one.arrays, "collision_force": one.arrays["collision_force"] + 100.0}
    return {"one": one, "<two>": Record(summary=summary, problem=text, arrays=arrays)}


@pytest.fixture
def saved(records: dict[str, Record], tmp_path: Path) -> list[Path]:
    for name, record in records.items():
        save_record(record, tmp_path / name)
    return [tmp_path / name for name in records]


def run(*arguments: object, code: int = 0) -> tuple[str, str]:
    result = runner.invoke(app, ["compare", *map(str, arguments)], env={"COLUMNS": "120"})
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output and result.stderr.count("error:") == (code == 2)
    return result.stdout, result.stderr


def test_numbers_and_differences_are_beside_each_other(records: dict[str, Record]) -> None:
    found = compare(records)
    rows = {row.label: [cell.text for cell in row.cells] for row in found.rows}
    assert rows["impulse [N s]"] == [f"{IMPULSE:.2f}", "12.50"]
    assert rows["replayed impulse [N s]"] == [f"{1.01 * IMPULSE:.2f}", "-"]
    (status,) = (row for row in found.rows if row.label == "status")
    assert [cell.good for cell in status.cells] == [True, False]
    # 1e4 and 10000 are the same number
    assert {d.key: d.values for d in found.problem} == {
        "target.mass_kg": ("5", "8"),
        "scenarios.0.name": ("-", "heavy"),
        "scenarios.0.mass": ("-", "2"),
    }
    casadi = records["one"].summary["versions"]["casadi"]
    assert {d.key: d.values for d in found.versions} == {"casadi": (casadi, "0.0.1")}


def test_without_a_file_problems_are_told_by_their_summaries(records: dict[str, Record]) -> None:
    one, two = records.values()
    changed = {**two.summary["problem"], "target": "FreeMass(mass=9.0)"}
    other = dataclasses.replace(two, problem="", summary={**two.summary, "problem": changed})
    found = compare({"one": one, "other": other})
    assert {d.key: d.values[1] for d in found.problem} == {"target": "FreeMass(mass=9.0)"}


def test_histories_begin_at_contact(records: dict[str, Record]) -> None:
    known = histories_of(records["one"])
    assert set(known) == {"force", "margin", "ratio"}
    time, force = known["force"]
    assert force[(time > 0.009) & (time < 0.011)] == pytest.approx(400.0)
    assert time[0] == pytest.approx(-records["one"].arrays["reference_contact_start"])
    time, ratio = known["ratio"]
    assert ratio[(time > 0.039) & (time < 0.0401)].max() == pytest.approx(0.8)


def test_the_picture_has_a_colour_each(records: dict[str, Record]) -> None:
    figure = comparison_picture(records)
    assert frowns(figure) == []
    titles = [axes.get_title() for axes in figure.axes]
    assert [t.split(" [")[0] for t in titles] == [
        "force on the target",
        "ZMP margin",
        "largest torque / limit",
    ]
    for axes in figure.axes:
        colours = [line.get_color() for line in axes.lines if len(line.get_xdata()) > 2]
        assert len(colours) == len(set(colours)) == 2
    one, two = (line.get_ydata().max() for line in figure.axes[0].lines)
    assert (one, two) == (700.0, 800.0)


def test_a_strike_has_numbers_and_no_histories(records: dict[str, Record]) -> None:
    robot = arm()
    strike = strike_record(robot, robot.posture("start"), np.zeros(robot.nv), np.zeros(robot.n))
    found = compare({**records, "strike": strike})
    assert all(len(row.cells) == 3 for row in found.rows)
    assert len(comparison_picture(found.records).axes) == 3 and "strike" in found.page().html
    with pytest.raises(InputError, match="none of these results has a motion"):
        comparison_picture({"a": strike, "b": strike})


@pytest.mark.parametrize("count", [1, 6])
def test_too_few_and_too_many_are_refused(records: dict[str, Record], count: int) -> None:
    with pytest.raises(InputError, match=f"give 2 to 5 results to compare, not {count}"):
        compare({str(k): records["one"] for k in range(count)})


def test_the_command_prints_and_writes(saved: list[Path], tmp_path: Path) -> None:
    out, _ = run(*saved, "--out", tmp_path / "new" / "place")
    for text in ("12.50", "target.mass_kg", "0.0.1", "<two>", "versions: differences"):
        assert text in out
    files = {path.name for path in (tmp_path / "new" / "place").iterdir()}
    assert files == {"compare.json", "compare.png", "compare.html"}
    with Image.open(tmp_path / "new" / "place" / "compare.png") as image:
        assert image.size[0] > 1000
    told = json.loads(run(*saved, "--json")[0])
    assert told == {"ok": True, **json.loads((tmp_path / "new" / "place" / "compare.json").read_text())}
    assert [row["name"] for row in told["results"]] == ["one", "<two>"]
    assert told["results"][0]["replayed"]["standing"] is True and "replayed" not in told["results"][1]
    assert told["problem"]["target.mass_kg"] == {"one": "5", "<two>": "8"}


def test_bad_results_are_one_message(saved: list[Path], tmp_path: Path) -> None:
    assert "given twice" in run(saved[0], saved[0] / "solution.npz", code=2)[1]
    assert "solution.npz" in run(saved[0], tmp_path / "none", code=2)[1]
    assert "give 2 to 5" in run(saved[0], code=2)[1]


def test_results_of_one_name_are_told_by_their_paths(records: dict[str, Record], tmp_path: Path) -> None:
    places = [tmp_path / which / "punch" for which in ("a", "b")]
    for place, record in zip(places, records.values(), strict=True):
        save_record(record, place)
    told = json.loads(run(*places, "--json")[0])
    assert [row["name"] for row in told["results"]] == [str(place) for place in places]


def test_the_page_works_in_a_browser(records: dict[str, Record], tmp_path: Path) -> None:
    far = dataclasses.replace(records["one"], problem=PROBLEM_FILE.replace("talos", "/a" * 150))
    path = compare({**records, "one": far}).page().save(tmp_path / "page.html")
    html = path.read_text(encoding="utf-8")
    assert "<two>" not in html.split('<div id="charts">')[0], "all text is escaped"
    assert {*re.findall(r"https?://[^\s\"'<>)]+", html)} == {"http://www.w3.org/2000/svg"}
    scripts = (
        "document.documentElement.scrollWidth <= innerWidth",
        "[...document.querySelectorAll('.scroll')].every((s) => s.scrollWidth <= s.clientWidth)",
        "document.querySelectorAll('.chart path.line').length",
        "document.querySelectorAll('.chart')[0].querySelectorAll('.key').length",
    )
    seen: list[Any] = visit(Job(page=path, scripts=scripts), Job(page=path, width=400, scripts=scripts[:1]))
    assert [visit.console for visit in seen] == [[], []]
    fits, whole, lines, keys = seen[0].values
    assert fits and whole and seen[1].values == [True] and keys == 2 and lines >= 6


def test_what_is_bolted_does_not_stand() -> None:
    replay = {"impulse_Ns": 1.0, "standing": True}
    columns: dict[str, dict[str, Any]] = {"planned": {"impulse_Ns": 1.0}, "free soles": replay}
    assert [row for row in result_rows(columns) if row.label == "stands at the end"] == []
    assert standing(replay) is None
    columns["free soles"] = {**replay, "sole_force_N": {"left": {"swing": 120.0}}}
    (row,) = (row for row in result_rows(columns) if row.label == "stands at the end")
    assert [cell.text for cell in row.cells] == ["", "yes"]
