"""Files are written whole, with the user's permissions, and through no link that someone has put there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from impactopt import InputError
from impactopt.codegen.files import open_own, write_atomically
from impactopt.files.output import write_file
from impactopt.sweeps.store import Journal


@pytest.fixture(params=[0o022, 0o077, 0o007])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_a_file_has_the_permissions_of_any_other_new_file(tmp_path: Path, umask: int) -> None:
    (tmp_path / "other").touch()
    write_file(tmp_path / "new", lambda file: file.write(b"new"))
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "other").stat().st_mode
    write_atomically(tmp_path / "private", lambda file: file.write(b"new"), mode=0o600)
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o600 & ~umask


def test_no_planted_name_is_opened(tmp_path: Path) -> None:
    victim, path = tmp_path / "victim", tmp_path / "summary.json"
    victim.write_text("precious")
    names: list[str] = []

    def note(file: IO[bytes]) -> None:
        names.append(Path(str(file.name)).name)
        file.write(b"new")

    path.symlink_to(victim)
    (tmp_path / f".{path.name}.{os.getpid()}.tmp").symlink_to(victim)
    write_file(path, note)
    write_file(path, note)
    assert victim.read_text() == "precious", "neither the place nor a name beside it is written through"
    assert not path.is_symlink()
    assert path.read_bytes() == b"new"
    assert names[0] != names[1], "a name that is the same twice can be planted"


def test_a_name_as_long_as_the_disk_allows_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / ("n" * os.pathconf(tmp_path, "PC_NAME_MAX"))
    write_file(path, lambda file: file.write(b"new"))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_what_is_gone_on_with_is_a_plain_file_of_that_name(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "link").symlink_to(victim)
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "folder", "pipe"):
        with pytest.raises(OSError):
            os.close(open_own(tmp_path / name, os.O_RDWR | os.O_CREAT))
        with pytest.raises(InputError, match=name):
            Journal(tmp_path / name)
    assert victim.read_text() == "precious"
