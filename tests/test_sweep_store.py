"""A sweep's directory: what is finished is there, whole; what is torn, damaged, changed or full is said."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from impactopt.errors import InputError
from impactopt.sweeps import sweep_from_data
from impactopt.sweeps.journal import HEAD, MARK, Entry, Journal
from impactopt.sweeps.store import Store
from impactopt.sweeps.table import merge_kinds, unit_of, write_table
from impactopt.sweeps.units import Found


def entry(unit: int, count: int = 3) -> Entry:
    rng = np.random.default_rng(unit)
    return Entry(
        unit=unit,
        peak_mb=100.0 + unit,
        columns={
            "status": ["solved"] * count,
            "reason": ["", 'odd "text"\n', "unit\x00"][:count],
            "impulse_Ns": rng.normal(size=count),
            "iterations": np.arange(count),
            "missing": [None, 0.1, None][:count],
        },
    )


def same(a: Entry, b: Entry) -> None:
    assert (a.unit, a.peak_mb, list(a.columns)) == (b.unit, b.peak_mb, list(b.columns))
    for name, values in a.columns.items():
        assert type(values) is type(b.columns[name])
        assert np.array_equal(values, b.columns[name])


def filled(path: Path, units: tuple[int, ...] = (2, 0, 1)) -> list[int]:
    """A journal of these units; where each record ends."""
    journal, ends = Journal(path), []
    for unit in units:
        journal.add(entry(unit))
        ends.append(path.stat().st_size)
    journal.close()
    return ends


def test_what_was_added_is_read_in_order_bit_by_bit(tmp_path: Path) -> None:
    filled(tmp_path / "j")
    journal = Journal(tmp_path / "j")
    assert journal.units == {0, 1, 2} and not journal.torn and not journal.damaged
    for found, unit in zip(journal.read(), (0, 1, 2), strict=True):
        same(found, entry(unit))
    journal.close()


def test_a_torn_end_is_cut_off_wherever_it_is_torn(tmp_path: Path) -> None:
    path = tmp_path / "j"
    ends = filled(path)
    whole = path.read_bytes()
    for size in range(ends[1] + 1, ends[2]):
        path.write_bytes(whole[:size])
        journal = Journal(path)
        assert journal.torn and journal.units == {2, 0} and path.stat().st_size == ends[1]
        journal.close()
    journal = Journal(path)
    journal.add(entry(1))
    journal.close()
    assert path.read_bytes() == whole


def test_damage_in_the_middle_costs_its_own_record(tmp_path: Path) -> None:
    path = tmp_path / "j"
    ends = filled(path)
    whole = bytearray(path.read_bytes())
    for place in range(ends[0], ends[1], 7):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        journal = Journal(path)
        assert journal.units == {2, 1} and journal.damaged == 1 and not journal.torn
        journal.add(entry(0))
        for found, unit in zip(journal.read(), (0, 1, 2), strict=True):
            same(found, entry(unit))
        journal.close()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]\n",
        b"{}\n",
        b"[" * 100_000,
        b'{"unit": -1, "peak_mb": 1, "lists": {}, "arrays": {}, "order": []}\n',
        b'{"unit": 1, "peak_mb": "x", "lists": {}, "arrays": {}, "order": []}\n',
        b'{"unit": 1, "peak_mb": 1, "lists": {}, "arrays": {"a": ["O", 1]}, "order": ["a"]}\n12345678',
        b'{"unit": 1, "peak_mb": 1, "lists": {}, "arrays": {"a": ["<f8", -1]}, "order": ["a"]}\n12345678',
        b'{"unit": 1, "peak_mb": 1, "lists": {}, "arrays": {"a": ["<f8", 1000000000000]}, "order": ["a"]}\n',
        b'{"unit": 1, "peak_mb": 1, "lists": {"a": [1], "b": []}, "arrays": {}, "order": ["a", "b"]}\n',
        b'{"unit": 1, "peak_mb": 1, "lists": {"a": [1]}, "arrays": {}, "order": ["b"]}\n',
        b'{"unit": 1, "peak_mb": 1, "lists": {"a": [[]]}, "arrays": {}, "order": ["a"]}\n',
    ],
)
def test_a_record_that_is_none_is_damaged_whatever_its_checksum(tmp_path: Path, content: bytes) -> None:
    journal = Journal(tmp_path / "j")
    journal.add(entry(0))
    journal.close()
    with (tmp_path / "j").open("ab") as file:
        file.write(MARK + HEAD.pack(len(content), zlib.crc32(content)) + content)
    journal = Journal(tmp_path / "j")
    journal.add(entry(2))
    assert journal.units == {0, 2}
    for found, unit in zip(journal.read(), (0, 2), strict=True):
        same(found, entry(unit))
    journal.close()


@pytest.mark.parametrize("content", [b"something else entirely", b"x", b"\nnot a unit" + MARK])
def test_a_file_of_others_is_refused_and_left_as_it_is(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "j").write_bytes(content)
    with pytest.raises(InputError, match="no journal of a sweep"):
        Journal(tmp_path / "j")
    assert (tmp_path / "j").read_bytes() == content


@pytest.mark.parametrize("length", range(len(MARK) + 1))
def test_a_first_record_that_was_torn_has_no_units(tmp_path: Path, length: int) -> None:
    (tmp_path / "j").write_bytes(MARK[:length])
    journal = Journal(tmp_path / "j")
    assert journal.torn == (length > 0) and not journal.units
    journal.close()


def test_a_full_disk_is_said_and_what_was_there_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "j"
    journal = Journal(path)
    journal.add(entry(0))
    size = path.stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 50, hard))
    try:
        with pytest.raises(
            InputError, match=r"cannot write .*: File too large; what was finished before is kept"
        ):
            journal.add(entry(1))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.stat().st_size == size and journal.units == {0}
    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(InputError, match="No space left on device"):
        journal.add(entry(1))
    monkeypatch.undo()
    assert path.stat().st_size == size
    journal.add(entry(1))
    journal.close()
    again = Journal(path)
    assert again.units == {0, 1} and not again.torn
    again.close()


def no_space(handle: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# ---------------------------------------------------------------- the directory
def sweep(**grid: Any) -> Any:
    return sweep_from_data({"sweep": {"problem": "arm_planar"}, "grid": grid or {"target.mass": [0.05, 0.1]}})


def test_the_same_sweep_goes_on_and_another_is_refused(tmp_path: Path) -> None:
    store = Store(sweep(), tmp_path)
    store.keep(1, Found(columns={"reason": [""]}, peak_mb=1.0))
    store.close()
    store = Store(sweep(), tmp_path)
    assert store.journal.units == {1}
    store.close()
    with pytest.raises(InputError) as caught:
        Store(sweep(**{"target.mass": [0.05, 0.2]}), tmp_path)
    assert "holds another sweep: grid.target.mass was [0.05, 0.1], is [0.05, 0.2]" in str(caught.value)
    Store(sweep(), tmp_path).close()  # the lock is free after a refusal


def test_rows_of_other_versions_are_not_mixed_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Store(sweep(), tmp_path).close()
    from impactopt.planning.solution import versions

    monkeypatch.setattr("impactopt.sweeps.store.versions", lambda: {**versions(), "casadi": "9.9"})
    with pytest.raises(InputError, match=r"were made with casadi 3.*this is casadi 9\.9"):
        Store(sweep(), tmp_path)


def test_a_lost_or_damaged_name_plate_is_said(tmp_path: Path) -> None:
    Store(sweep(), tmp_path).close()
    plate = tmp_path / "sweep.json"
    plate.write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"sweep\.json cannot be read"):
        Store(sweep(), tmp_path)
    plate.unlink()
    with pytest.raises(InputError, match="which says of which, is gone"):
        Store(sweep(), tmp_path)


def test_two_processes_do_not_share_a_directory(tmp_path: Path) -> None:
    code = (
        "import fcntl, os, sys, time\n"
        f"h = os.open({str(tmp_path / '.lock')!r}, os.O_RDWR | os.O_CREAT)\n"
        "fcntl.flock(h, fcntl.LOCK_EX); print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(InputError, match="another process is at work"):
            Store(sweep(), tmp_path)
        other.kill()
    Store(sweep(), tmp_path).close()  # a killed process holds nothing


# ---------------------------------------------------------------- the table
def test_small_parts_and_large_ones_become_one_table_with_units(tmp_path: Path) -> None:
    parts: list[Any] = [
        (0, {"reason": [""], "x_m": [1], "kind": ["a"], "at": [[1, {"y": 0}]], "n": [3]}),
        (1, {"reason": ["bad"]}),
        (
            2,
            {
                "reason": ["", ""],
                "x_m": np.array([0.5, np.nan]),
                "kind": ["b", "c"],
                "at": [None, {"y": 0}],
                "n": [4, 5],
            },
        ),
    ]
    kinds: dict[str, str] = {}
    for _, columns in parts:
        merge_kinds(kinds, columns)
    write_table(tmp_path / "t.parquet", parts, kinds, {"name": "of tests"})
    table = pq.read_table(tmp_path / "t.parquet")
    assert table.to_pydict() == {
        "case": [0, 1, 2, 3],
        "reason": ["", "bad", "", ""],
        "x_m": [1.0, None, 0.5, None],
        "kind": ["a", None, "b", "c"],
        "at": ['[1, {"y": 0}]', None, None, '{"y": 0}'],
        "n": [3, None, 4, 5],
    }
    assert table.schema.field("x_m").metadata == {b"unit": b"m"}
    assert table.schema.metadata[b"impactopt.name"] == b"of tests"


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("impulse_Ns", "N s"),
        ("contact.stiffness_N_m", "N/m"),
        ("robot.torque_limit_N_m", "N m"),
        ("contact.damping_N_s_m", "N s/m"),
        ("problem.point_m.1", "m"),
        ("at_contact.joints_rad.elbow", "rad"),
        ("hand_speed_m_s", "m/s"),
        ("contact_ms", "ms"),
        ("seconds", "s"),
        ("iterations", ""),
        ("torque_ratio_swing", ""),
    ],
)
def test_units_are_read_off_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit


def test_a_full_disk_leaves_the_table_of_before(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    write_table(path, [(0, {"x": np.arange(3.0)})], {"x": "float"}, {})
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        with pytest.raises(InputError, match=r"cannot write .*: File too large"):
            write_table(path, [(0, {"x": np.random.default_rng(0).random(100_000)})], {"x": "float"}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and [*tmp_path.iterdir()] == [path]
