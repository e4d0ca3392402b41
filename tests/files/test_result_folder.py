"""What a directory of results holds: one result, a good one if there was one, and nothing of another."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impactopt import InputError, Status, load_record
from impactopt.cli.show import PAGE
from impactopt.files.output import (
    DERIVED,
    keep_record,
    keep_series,
    remove_file,
    save_record,
    set_aside,
    write_file,
)
from impactopt.files.record import Record
from impactopt.report.pictures import PICTURES

NOT_SOLVED = [s for s in Status if not s.usable]


def record(name: str, status: Status | None = Status.SOLVED) -> Record:
    summary = {"name": name} if status is None else {"name": name, "status": status.value}
    return Record(summary=summary, problem=name, arrays={"x": np.arange(3.0)})


def derive(directory: Path, name: str) -> None:
    """All that is made of a result's numbers, and a file of the user's."""
    for file in (*DERIVED, "notes.txt"):
        (directory / file).write_text(name, encoding="utf-8")


def names(directory: Path) -> set[str]:
    return {path.name for path in directory.iterdir()}


def kept(directory: Path) -> str:
    """Which result is there; its numbers and its summary are of the same."""
    name = str(load_record(directory).summary["name"])
    assert json.loads((directory / "summary.json").read_text(encoding="utf-8"))["name"] == name
    return name


def test_what_is_made_of_a_result_is_known() -> None:
    assert set(DERIVED) == {PAGE, "replay.json", *(f"{name}.png" for name in PICTURES)}


def test_new_numbers_leave_nothing_of_the_old_ones(tmp_path: Path) -> None:
    save_record(record("old"), tmp_path)
    derive(tmp_path, "old")
    save_record(record("new"), tmp_path)
    assert kept(tmp_path) == "new"
    assert names(tmp_path) == {"solution.npz", "summary.json", "notes.txt"}, "and what is not ours stays"


@pytest.mark.parametrize("status", NOT_SOLVED)
def test_what_is_not_solved_leaves_a_good_result_alone(tmp_path: Path, status: Status) -> None:
    keep_record(record("good"), tmp_path)
    derive(tmp_path, "good")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in ("first", "second"):  # one failure takes the place of another
        bad = record(name, status)
        written = keep_record(bad, tmp_path)
        assert {path.parent for path in written} == {tmp_path / "failed"}
        assert kept(tmp_path / "failed") == name
        assert bad.summary["set_aside"] == {
            "directory": str(tmp_path / "failed"),
            "kept": str(tmp_path),
        }
        assert load_record(tmp_path / "failed").summary == bad.summary
        assert str(tmp_path / "failed") in set_aside(bad.summary)
        derive(tmp_path / "failed", name)
    after = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    assert after == before and names(tmp_path) == {*before, "failed"}


def test_a_good_result_takes_the_place_of_all_there_was(tmp_path: Path) -> None:
    keep_record(record("old"), tmp_path)
    keep_record(record("bad", Status.FAILED), tmp_path)
    derive(tmp_path / "failed", "bad")
    good = record("new", Status.ACCEPTABLE)
    keep_record(good, tmp_path)
    assert kept(tmp_path) == "new" and set_aside(good.summary) == ""
    assert names(tmp_path) == {"solution.npz", "summary.json", "failed"}
    assert names(tmp_path / "failed") == {"notes.txt"}, "the user's own"
    (tmp_path / "failed" / "notes.txt").unlink()
    keep_record(record("bad", Status.FAILED), tmp_path)
    keep_record(record("newer"), tmp_path)
    assert names(tmp_path) == {"solution.npz", "summary.json"}


@pytest.mark.parametrize("there", ["nothing", "failed", "damaged", "of no status"])
def test_where_there_is_no_good_result_a_failed_one_is_kept(tmp_path: Path, there: str) -> None:
    if there == "failed":
        keep_record(record("old", Status.INFEASIBLE), tmp_path)
        derive(tmp_path, "old")
    elif there == "of no status":
        save_record(record("old", None), tmp_path)
    elif there == "damaged":
        (tmp_path / "solution.npz").write_bytes(b"hello")
        (tmp_path / "summary.json").write_text("[1, 2", encoding="utf-8")
    bad = record("new", Status.TIME_LIMIT)
    keep_record(bad, tmp_path)
    assert kept(tmp_path) == "new" and "set_aside" not in bad.summary
    assert names(tmp_path) - {"notes.txt"} == {"solution.npz", "summary.json"}


def test_a_good_result_of_a_newer_version_is_one(tmp_path: Path) -> None:
    save_record(record("newer"), tmp_path)
    np.savez(tmp_path / "solution.npz", format=99)
    keep_record(record("bad", Status.FAILED), tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["name"] == "newer"
    assert kept(tmp_path / "failed") == "bad"


class Killed(BaseException):
    """The process ends here: what would clean up after it does not run."""


@pytest.mark.parametrize("picture", [False, True], ids=["numbers", "with what is made of them"])
def test_wherever_a_process_ends_all_files_are_of_one_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, picture: bool
) -> None:
    """Stopped before each of its steps on disk in turn; the next one goes through all the same."""
    steps, most = 0, -1
    unlink, swap, sync = Path.unlink, os.replace, os.fsync

    def stopping(do: Any) -> Any:
        def step(*arguments: Any, **options: Any) -> Any:
            nonlocal steps
            if most >= 0 and steps >= most:
                raise Killed
            steps += 1
            return do(*arguments, **options)

        return step

    monkeypatch.setattr(Path, "unlink", stopping(unlink))
    monkeypatch.setattr(os, "replace", stopping(swap))
    monkeypatch.setattr(os, "fsync", stopping(sync))

    def work(directory: Path) -> None:
        keep_record(record("new"), directory)
        for name in ("force.png", PAGE) if picture else ():
            write_file(directory / name, lambda file: file.write(b"new"))

    work(tmp_path / "whole")
    needed, seen = steps, set()
    for last in range(needed + 20):
        directory, most, steps = tmp_path / str(last), -1, 0
        save_record(record("old"), directory)
        derive(directory, "old")
        most, steps = last, 0
        try:
            work(directory)
        except Killed:
            pass
        else:
            break
        most = -1
        name = str(load_record(directory).summary["name"])
        seen.add(name)
        for path in directory.glob("[!.]*"):
            if path.name in DERIVED:
                assert path.read_text(encoding="utf-8") == name, (last, path.name)
            elif path.name == "summary.json":
                assert json.loads(path.read_text(encoding="utf-8"))["name"] == name
        assert (directory / "notes.txt").exists()
        work(directory)
        assert kept(directory) == "new"
    else:
        raise AssertionError("it never got to its end")
    assert seen == {"old", "new"}, "both before and after the one step"


def test_a_series_that_ends_early_leaves_a_whole_one_alone(tmp_path: Path) -> None:
    whole: dict[str, Any] = {"done": True, "reason": "", "blows": [1, 2]}
    early: dict[str, Any] = {"done": False, "reason": "no plan", "blows": [1]}
    assert keep_series(dict(early), tmp_path) == tmp_path / "blows.json", "there was no other"
    assert keep_series(dict(whole), tmp_path) == tmp_path / "blows.json"
    told = dict(early)
    assert keep_series(told, tmp_path) == tmp_path / "failed" / "blows.json"
    assert json.loads((tmp_path / "failed" / "blows.json").read_text(encoding="utf-8")) == told
    assert set_aside(told)
    assert json.loads((tmp_path / "blows.json").read_text(encoding="utf-8")) == whole
    keep_series(dict(whole), tmp_path)
    assert names(tmp_path) == {"blows.json"}
    (tmp_path / "failed").write_text("a file of the user's", encoding="utf-8")
    with pytest.raises(InputError, match="cannot make the directory"):
        keep_series(dict(early), tmp_path)


def test_what_cannot_be_removed_is_told_before_anything_is_lost(tmp_path: Path) -> None:
    save_record(record("old"), tmp_path)
    (tmp_path / "force.png").mkdir()
    with pytest.raises(InputError, match=r"cannot write over .*force\.png"):
        save_record(record("new"), tmp_path)
    assert load_record(tmp_path).summary["name"] == "old"
    with pytest.raises(InputError, match="cannot write over"):
        remove_file(tmp_path / "force.png")
