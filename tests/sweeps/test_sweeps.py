"""Sweeps on processes of this machine: nothing finished is lost, and rows do not depend on accidents."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
import pytest
from support.sweep_workers import pools, slow, unlucky
from typer.testing import CliRunner

from impactopt import InputError, PowerLimit, collide_many, load_problem, load_record, sweep, write_problem
from impactopt.cli.app import app
from impactopt.simulation.workers import Died, each_on_workers
from impactopt.sweeps import SweepProgress, sweep_from_data
from impactopt.sweeps.design import Found, Unit, Work
from impactopt.sweeps.evaluate import ENDED_BY_WATCHDOG, evaluate, on_processes
from impactopt.sweeps.running import MAX_UNIT
from impactopt.sweeps.sections import SweepSection
from impactopt.sweeps.store import Entry, Journal

TIMES = ("seconds", "solve_seconds", "build_seconds")  # which no two runs share
RESISTANCES = [500.0, 800.0, 600.0]
ITERATIONS = 34  # too few for some; nails that cannot be driven would take ten times as long
SWEEP = {
    "sweep": {"problem": "arm_planar", "case_kind": "strike", "name": "nails"},
    "set": {"solver.ipm.max_iterations": ITERATIONS},
    "grid": {"target.resistance": RESISTANCES},
}


def rows(table: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = pq.read_table(table).to_pylist()
    return [{name: value for name, value in row.items() if name not in TIMES} for row in found]


def failures(found: list[dict[str, Any]]) -> int:
    return sum(row["reason"] != "" for row in found)


@pytest.fixture(scope="module")
def undisturbed() -> list[dict[str, Any]]:
    """The rows, one after the other in this process."""
    chosen = sweep_from_data(SWEEP)
    work = Work(data=chosen.problem.data, path=chosen.problem.path, settings=chosen.settings)
    out = []
    for case, value in enumerate(RESISTANCES):
        unit = Unit(index=case, first=case, count=1, columns={"target.resistance_N": [value]})
        columns = evaluate(work, unit).columns
        row = {"case": case, "target.resistance_N": value}
        out.append(row | {name: column[0] for name, column in columns.items() if name not in TIMES})
    assert 0 < failures(out) < len(out)
    return out


def test_ctrl_c_and_a_worker_that_is_killed_cost_nothing_and_the_table_tells_all(
    tmp_path: Path, undisturbed: list[dict[str, Any]]
) -> None:
    def stop(now: SweepProgress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # Ctrl-C
        sweep(SWEEP, tmp_path / "out", workers=1, progress=stop)
    assert multiprocessing.active_children() == []
    assert rows(tmp_path / "out" / "table.parquet") == undisturbed[:1]
    told: list[SweepProgress] = []

    def kill_one(now: SweepProgress) -> None:
        told.append(now)
        if len(told) == 1:
            victim = multiprocessing.active_children()[0]
            assert victim.pid is not None
            os.kill(victim.pid, signal.SIGKILL)

    result = sweep(SWEEP, tmp_path / "out", workers=1, progress=kill_one)
    assert rows(result.table) == undisturbed
    assert (result.cases, result.done, result.failed, result.resumed) == (3, 3, failures(undisturbed), 1)
    assert [now.done for now in told] == [2, 3] and told[-1].remaining == 0
    best = max((row for row in undisturbed if not row["reason"]), key=lambda row: row["impulse_Ns"])
    assert (result.best, result.best_case) == (best["impulse_Ns"], best["case"])
    assert 50 < result.peak_worker_mb < 1000
    assert multiprocessing.active_children() == []
    schema = pq.read_schema(result.table)
    assert schema.field("impulse_Ns").metadata[b"unit"] == b"N s"
    said = {name.decode(): text.decode() for name, text in schema.metadata.items()}
    chosen = sweep_from_data(SWEEP)
    assert said["impactopt.problem_hash"] == chosen.problem.build().hash
    assert said["impactopt.sweep_hash"] == chosen.hash
    assert json.loads(said["impactopt.versions"])["casadi"]
    assert json.loads(said["impactopt.units"])["target.resistance_N"] == "N"


COMMAND = [sys.executable, "-m", "impactopt.cli.app", "sweep"]


def finished(journal: Path) -> int:
    """Units in a journal that another process writes."""
    try:
        with closing(sqlite3.connect(f"file:{journal}?mode=ro", uri=True)) as file:
            return int(file.execute("SELECT count(*) FROM units").fetchone()[0])
    except sqlite3.Error:  # not there yet
        return 0


@pytest.mark.slow
def test_a_parent_that_is_killed_leaves_no_orphans_and_its_rows(
    tmp_path: Path, undisturbed: list[dict[str, Any]]
) -> None:
    file, out = tmp_path / "nails.toml", tmp_path / "out"
    values = ", ".join(map(str, RESISTANCES))
    file.write_text(
        f'[sweep]\nproblem = "arm_planar"\ncase_kind = "strike"\n'
        f"[set]\nsolver.ipm.max_iterations = {ITERATIONS}\n[grid]\ntarget.resistance = [{values}]\n",
        encoding="utf-8",
    )
    parent = subprocess.Popen(
        [*COMMAND, str(file), "--out", str(out), "--workers", "2"], stderr=subprocess.PIPE, text=True
    )
    journal, until = out / "units.sqlite", time.monotonic() + 60
    while not finished(journal) and time.monotonic() < until:
        time.sleep(0.01)
    workers = psutil.Process(parent.pid).children(recursive=True)
    parent.kill()
    parent.communicate()
    _, alive = psutil.wait_procs(workers, timeout=5)
    assert len(workers) >= 2 and alive == []
    again = CliRunner().invoke(app, ["sweep", str(file), "--out", str(out), "--workers", "1", "--json"])
    summary = json.loads(again.stdout)
    names = ["cases", "done", "failed", "resumed", "seconds", "rate_per_second", "peak_worker_mb", "table"]
    assert list(summary) == ["ok", *names]
    assert (summary["cases"], summary["done"], again.exit_code) == (3, 3, 0)
    assert summary["failed"] == failures(undisturbed)
    assert 1 <= summary["resumed"] < 3
    assert "are finished already" in again.stderr
    assert rows(Path(summary["table"])) == undisturbed


@pytest.mark.slow
def test_a_failure_is_a_row_with_its_reason_and_results_are_kept_on_demand(tmp_path: Path) -> None:
    points = [[0.7, 0.0, 0.75], [30.0, 0.0, 0.75]]
    given = {
        "sweep": {"problem": "arm_planar", "case_kind": "strike", "trajectories": True},
        "grid": {"problem.point": points},
    }
    out = tmp_path / "out"
    result = sweep(given, out, workers=1)
    good, bad = rows(result.table)
    assert (result.done, result.failed) == (2, 1)
    assert good["problem.point_m"] == json.dumps(points[0]) and good["reason"] == ""
    assert bad["status"] == "refused" and "reach" in bad["reason"] and bad["impulse_Ns"] is None
    record = load_record(out / "cases" / "000000")
    assert record.summary["impulse_Ns"] == good["impulse_Ns"]
    assert "[0.7" in record.problem
    assert not (out / "cases" / "000001").exists()
    assert sum(result.reasons.values()) == 1
    assert sweep(given, out, workers=1, again=True).resumed == 2  # another try would not help
    journal = Journal(out / "units.sqlite")
    lost = Found(columns={"status": ["crashed"], "reason": ["its process died"]}, peak_mb=1.0)
    journal.add(Entry(unit=0, peak_mb=1.0, columns=lost.columns))
    journal.close()
    assert sweep(given, out, workers=1).failed == 2
    again = sweep(given, out, workers=1, again=True)
    assert (again.resumed, again.failed, rows(again.table)) == (1, 1, [good, bad])


@pytest.mark.slow
def test_a_problem_that_only_a_varied_key_completes_is_swept(tmp_path: Path) -> None:
    """No motor of the arm has a bound on its power, so the term alone is refused; each case has a limit. A
    first case that is out of reach is a row with its reason, and no reason to refuse the sweep.
    """
    problem = replace(load_problem("arm_planar"), terms=(PowerLimit(limit=1.0),))
    text = write_problem(problem).replace("limit_W = 1.0", "")
    (tmp_path / "arm.toml").write_text(text, "utf-8")
    with pytest.raises(InputError, match="give a limit"):
        load_problem(tmp_path / "arm.toml")
    given = {
        "sweep": {"problem": str(tmp_path / "arm.toml"), "case_kind": "strike"},
        "list": {
            "terms.power_limit.limit": [200.0, 200.0, 1000.0],
            "problem.point_m": [[9.0, 0.0, 0.75], [0.7, 0.0, 0.75], [0.7, 0.0, 0.75]],
        },
    }
    far, weak, strong = rows(sweep(given, tmp_path / "out", workers=1).table)
    assert "out of reach" in far["reason"] and weak["reason"] == strong["reason"] == ""
    assert weak["impulse_Ns"] <= strong["impulse_Ns"]


# ---------------------------------------------------------------- workers
@pytest.mark.slow
def test_an_input_is_tried_again_so_often_and_no_more(tmp_path: Path) -> None:
    found = each_on_workers(unlucky, tmp_path, enumerate(range(3)), workers=2, again=lambda d: d.tries < 3)
    assert dict(found) == {0: Died(code=-signal.SIGKILL, tries=3), 1: 1, 2: 2}


@pytest.mark.slow
def test_a_case_that_does_not_stop_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    began = time.perf_counter()
    assert dict(each_on_workers(slow, 0.3, [(0, 0)], workers=1)) == {0: Died(code=ENDED_BY_WATCHDOG, tries=1)}
    assert time.perf_counter() - began > 3 * 0.8 * 0.3
    work = Work(data={}, path=Path("p"), settings=SweepSection(problem="p", time_limit_s=0.5))
    units = [Unit(index=k, first=k, count=1, columns={}) for k in range(2)]
    ends = [Died(code=ENDED_BY_WATCHDOG, tries=1), Died(code=-signal.SIGSEGV, tries=3)]
    monkeypatch.setattr(
        "impactopt.sweeps.evaluate.each_on_workers",
        lambda *a, **k: zip(*[[0, 1], ends], strict=True) if list(a[2]) else None,
    )
    late, crashed = (found.columns for _, found in on_processes(work, units, workers=1))
    assert late["reason"] == ["it took longer than 0.5 s and did not stop by itself"]
    assert crashed["reason"] == ["its process died 3 times (killed by SIGSEGV)"]


@pytest.mark.slow
def test_workers_have_one_blas_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)  # conftest's
    assert dict(each_on_workers(pools, None, [(0, 0)], workers=1)) == {0: 1}


def test_a_worker_of_another_version_is_refused() -> None:
    work = Work(data={}, path=Path("p"), settings=SweepSection(problem="p"), version="0.0.0")
    with pytest.raises(InputError, match=r"the sweep 0\.0\.0; install the same"):
        evaluate(work, Unit(index=0, first=0, count=1, columns={}))


@pytest.mark.slow
def test_a_script_that_its_workers_run_again_is_told_what_helps(tmp_path: Path) -> None:
    """A single worker of a sweep is a process too: to ask for one does not help."""
    script = tmp_path / "script.py"
    script.write_text(f"import impactopt\nimpactopt.sweep({SWEEP!r}, 'out', workers=1)\n", encoding="utf-8")
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 1 and 'under `if __name__ == "__main__":`' in last
    assert "workers=1" not in last


# ---------------------------------------------------------------- the command
def test_a_bad_sweep_file_is_exit_code_2(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["sweep", str(tmp_path / "none.toml"), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2 and "none.toml" in result.output
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- collisions
@pytest.mark.slow
def test_collisions_go_in_chunks_and_are_the_same_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(MAX_UNIT, "collision", 64)
    over = {
        "target.mass": {"from": 0.05, "to": 1.0},
        "contact.stiffness": {"from": 1e5, "to": 1e6, "scale": "log"},
        "at_contact.speed": {"from": 0.1, "to": 1.0},
    }
    given = {
        "sweep": {
            "problem": "arm7",
            "case_kind": "collision",
            "outputs": ["impulse_Ns", "peak_force_N", "contact_ms"],
        },
        "draw": {"method": "latin hypercube", "count": 150, "over": over},
    }
    result = sweep(given, tmp_path / "out", workers=2)
    table = pq.read_table(result.table).to_pydict()
    assert result.done == 150 and table["case"] == list(range(150))
    columns = sweep_from_data(given).design.columns(0, 150)
    for case in (0, 63, 64, 149):
        one = collide_many(
            "arm7", {key: [x[case]] for key, x in columns.items()}, outputs=given["sweep"]["outputs"]
        )
        assert one.pop("reason")[0] == table["reason"][case] == ""
        for name, values in one.items():
            assert table[name][case] == pytest.approx(values[0], rel=1e-12)
        for key, x in columns.items():
            assert table[key][case] == x[case]


def test_what_collisions_do_not_have_is_said() -> None:
    given = {
        "sweep": {"problem": "arm7", "case_kind": "collision", "starts": 2},
        "grid": {"target.mass": [1.0]},
    }
    collisions = {**given, "sweep": {"problem": "arm7", "case_kind": "collision"}}
    with pytest.raises(InputError, match=r"\[sweep\] starts: collisions have none"):
        sweep_from_data(given)
    with pytest.raises(InputError, match=r"speed_m_s: missing"):
        sweep_from_data(collisions)
    with pytest.raises(InputError, match=r"^mine: \[at_contact\]: velocty: unknown key \(did you mean"):
        sweep_from_data({**collisions, "at_contact": {"speed": 1.0, "velocty": "least rates"}}, where="mine")
    both = {"speed": 1.0, "speed_m_s": 2.0}
    with pytest.raises(InputError, match="speed: unknown key"):
        sweep_from_data({**collisions, "at_contact": both})
    with pytest.raises(InputError, match="of collisions only"):
        sweep_from_data({"sweep": {"problem": "arm7", "outputs": ["impulse_Ns"]}})
