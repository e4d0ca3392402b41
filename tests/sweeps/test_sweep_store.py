"""A sweep's directory: what is finished is there, whole; what is torn, damaged, changed or full is said."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import resource
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.sweep_entries import entry

from impactopt import InputError
from impactopt.sweeps import sweep_from_data
from impactopt.sweeps.design import Found
from impactopt.sweeps.store import Entry, Journal, Store
from impactopt.sweeps.table import merge_kinds, read_columns, unit_of, write_table


def same(a: Entry, b: Entry) -> None:
    assert (a.unit, a.peak_mb, list(a.columns)) == (b.unit, b.peak_mb, list(b.columns))
    for name, values in a.columns.items():
        assert type(values) is type(b.columns[name])
        assert np.array_equal(values, b.columns[name])


def filled(path: Path, units: tuple[int, ...] = (2, 0, 1)) -> None:
    """A journal of these units."""
    journal = Journal(path)
    for unit in units:
        journal.add(entry(unit))
    journal.close()


def test_what_was_added_is_read_in_order_bit_by_bit(tmp_path: Path) -> None:
    filled(tmp_path / "j")
    journal = Journal(tmp_path / "j")
    assert journal.units == {0, 1, 2} and not journal.damaged
    for found, unit in zip(journal.read(), (0, 1, 2), strict=True):
        same(found, entry(unit))
    journal.close()
    assert [path.name for path in tmp_path.iterdir()] == ["j"]  # one file has it all


ADDING = """
import sys
import zlib
from pathlib import Path
from impactopt.sweeps.store import Journal
from support.sweep_entries import entry
journal = Journal(Path(sys.argv[1]))
for unit in range(10**9):
    journal.add(entry(unit))
    print(unit, flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("said", [1, 30])
def test_a_kill_loses_no_unit_that_was_added(tmp_path: Path, said: int) -> None:
    command = [sys.executable, "-c", ADDING, str(tmp_path / "j")]
    tests = str(Path(__file__).parents[1])
    path = os.pathsep.join([tests, *filter(None, [os.environ.get("PYTHONPATH")])])
    with subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}) as adding:
        assert adding.stdout is not None
        for _ in range(said):
            last = int(adding.stdout.readline())
        adding.kill()
    journal = Journal(tmp_path / "j")
    assert journal.units >= set(range(last + 1)) and not journal.damaged
    for found in journal.read():
        same(found, entry(found.unit))
    journal.add(entry(10**6))
    journal.close()


def test_no_damage_gives_wrong_numbers_or_is_passed_over(tmp_path: Path) -> None:
    """Wherever a bit is wrong: the unit is done again, or the file is refused, and left as it is."""
    path = tmp_path / "j"
    filled(path)
    whole = path.read_bytes()
    counted = {"refused": 0, "again": 0, "no matter": 0}
    for place in range(0, len(whole), 29):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        try:
            journal = Journal(path)
        except InputError as error:
            assert str(path) in str(error)
            assert path.read_bytes() == damaged
            counted["refused"] += 1
            continue
        for found in journal.read():
            same(found, entry(found.unit))
        assert journal.damaged == 3 - len(journal.units)
        counted["again" if journal.damaged else "no matter"] += 1
        journal.close()
    assert counted["refused"] > 3 and counted["again"] > 10


@pytest.mark.parametrize("size", [1, 99, 100, 4096])
def test_a_file_that_was_cut_off_is_refused_and_left_as_it_is(tmp_path: Path, size: int) -> None:
    path = tmp_path / "j"
    filled(path)
    cut = path.read_bytes()[:size]
    path.write_bytes(cut)
    with pytest.raises(InputError, match="give another --out"):
        Journal(path)
    assert path.read_bytes() == cut


@pytest.mark.parametrize("content", [b"", "text", b"[]\n"])
def test_a_row_of_another_checksum_is_damaged(tmp_path: Path, content: bytes | str) -> None:
    filled(tmp_path / "j", (0,))
    with closing(sqlite3.connect(tmp_path / "j")) as file, file:
        file.execute("INSERT INTO units VALUES (1, 12345, ?)", (content,))
    journal = Journal(tmp_path / "j")
    assert journal.units == {0} and journal.damaged == 1
    journal.add(entry(1))
    for found, unit in zip(journal.read(), (0, 1), strict=True):
        same(found, entry(unit))
    journal.close()


def test_another_programs_file_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    text, other = tmp_path / "text", tmp_path / "other"
    text.write_bytes(b"something else entirely")
    with closing(sqlite3.connect(other)) as file, file:
        file.execute("CREATE TABLE units (unit INTEGER)")
    for path in (text, other):
        before = path.read_bytes()
        with pytest.raises(InputError, match=rf"{path}.*give another --out"):
            Journal(path)
        assert path.read_bytes() == before


def test_nothing_is_written_through_a_link_beside_it(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious", encoding="utf-8")
    (tmp_path / "j-journal").symlink_to(victim)
    filled(tmp_path / "j")
    assert victim.read_text(encoding="utf-8") == "precious"


def test_a_full_disk_is_said_and_what_was_there_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "j"
    journal = Journal(path)
    journal.add(entry(0))
    size = path.stat().st_size
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 50, hard))
    try:
        with pytest.raises(InputError, match=r"cannot write .*; finished cases are kept"):
            journal.add(entry(1, count=3000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert journal.units == {0}
    journal.add(entry(1))
    journal.close()
    again = Journal(path)
    assert again.units == {0, 1} and not again.damaged
    again.close()


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


def test_files_that_a_sweep_would_replace_are_refused(tmp_path: Path) -> None:
    """Others may be beside its own."""
    (tmp_path / "notes.txt").write_text("mine")
    for name in ("table.parquet", "sweep.toml"):
        own = tmp_path / name
        own.write_text("mine")
        with pytest.raises(InputError, match=rf"{name} is of no sweep .*, and would be replaced"):
            Store(sweep(), tmp_path)
        assert own.read_text() == "mine" and not (tmp_path / "sweep.json").exists()
        own.unlink()
    Store(sweep(), tmp_path).close()


URDF = """<robot name="lever"><link name="base"/><link name="lever"><inertial><mass value="1"/>
<origin xyz="0.2 0 0"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="lever"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="100" velocity="8"/></joint></robot>"""
LEVER = """
[problem]
striker = "tip"
start = "down"
point_m = [0.35103302, 0.0, -0.19177022]
normal = [0.0, 0.0, -1.0]
[target]
mass_kg = 2.0
[contact]
stiffness_N_m = 1e4
damping_N_s_m = 100.0
[robot]
urdf = "lever.urdf"
floating = false
armature_kg_m2 = 0.1
strikers = [{name = "tip", frame = "lever", point_m = [0.4, 0.0, 0.0]}]
postures_rad.down.hinge = 0.5
"""


def test_rows_of_a_changed_urdf_are_not_mixed_in(tmp_path: Path) -> None:
    (tmp_path / "lever.toml").write_text(LEVER, encoding="utf-8")
    (tmp_path / "lever.urdf").write_text(URDF, encoding="utf-8")

    def lever() -> Any:
        data = {"problem": str(tmp_path / "lever.toml"), "case_kind": "collision"}
        return sweep_from_data({"sweep": data, "at_contact": {"speed_m_s": 1.0, "posture": "down"}})

    for _ in range(2):
        Store(lever(), tmp_path / "out").close()
    (tmp_path / "lever.urdf").write_text(URDF.replace('mass value="1"', 'mass value="4"'), encoding="utf-8")
    with pytest.raises(InputError, match=r"another sweep: content of robot\.urdf lever\.urdf was .*, is"):
        Store(lever(), tmp_path / "out")


def test_rows_of_other_versions_are_not_mixed_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Store(sweep(), tmp_path).close()
    from impactopt.planning.solution import versions

    monkeypatch.setattr("impactopt.sweeps.store.versions", lambda: {**versions(), "casadi": "9.9"})
    with pytest.raises(InputError, match=r"were computed with casadi 3.*this is casadi 9\.9"):
        Store(sweep(), tmp_path)


def test_results_of_an_older_journal_are_left_as_they_are(tmp_path: Path) -> None:
    Store(sweep(), tmp_path).close()
    (tmp_path / "units.sqlite").rename(tmp_path / "units.journal")
    plate = tmp_path / "sweep.json"
    plate.write_bytes(plate.read_bytes().replace(b'"format": 3', b'"format": 1'))
    with pytest.raises(InputError, match="end this sweep with the version that began it, or give another"):
        Store(sweep(), tmp_path)
    assert not (tmp_path / "units.sqlite").exists()


def test_a_lost_or_damaged_name_plate_is_said(tmp_path: Path) -> None:
    Store(sweep(), tmp_path).close()
    plate = tmp_path / "sweep.json"
    whole = json.loads(plate.read_text(encoding="utf-8"))
    for damaged in ("{", "[" * 100_000):
        plate.write_text(damaged, encoding="utf-8")
        with pytest.raises(InputError, match=r"sweep\.json cannot be read"):
            Store(sweep(), tmp_path)
    for versions in (None, {}, {**whole["versions"], "lost": "1.0"}):
        plate.write_text(json.dumps({**whole, "versions": versions}), encoding="utf-8")
        with pytest.raises(InputError, match="were computed with"):
            Store(sweep(), tmp_path)
    plate.unlink()
    with pytest.raises(InputError, match="which identifies it, is missing"):
        Store(sweep(), tmp_path)


def test_two_processes_do_not_share_a_directory(tmp_path: Path) -> None:
    code = (
        "import fcntl, os, sys, time\n"
        f"h = os.open({str(tmp_path / '.lock')!r}, os.O_RDWR | os.O_CREAT)\n"
        "fcntl.flock(h, fcntl.LOCK_EX); print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        with pytest.raises(InputError, match="another process is working"):
            Store(sweep(), tmp_path)
        other.kill()
    Store(sweep(), tmp_path).close()  # a killed process holds nothing


def test_a_disk_without_locks_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(handle: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with pytest.raises(InputError, match=r"\.lock cannot be locked: .*; remove it, or give another --out"):
        Store(sweep(), tmp_path)


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


def test_a_number_that_no_case_has_is_a_column_of_nulls(tmp_path: Path) -> None:
    # the impulse of a rigid impact has no peak of its force
    parts: list[Any] = [(0, {"reason": [""], "peak_force_N": [None]}), (1, {"reason": ["bad"]})]
    kinds: dict[str, str] = {}
    for _, columns in parts:
        merge_kinds(kinds, columns)
    write_table(tmp_path / "t.parquet", parts, kinds, {})
    assert np.isnan(read_columns(tmp_path / "t.parquet", ["peak_force_N"])["peak_force_N"]).all()
    assert pq.read_schema(tmp_path / "t.parquet").field("peak_force_N").type == "double"


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
