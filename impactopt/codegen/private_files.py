"""Files and directories that only this user can write: what makes it safe to load code from them."""

from __future__ import annotations

import atexit
import contextlib
import functools
import itertools
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from impactopt.codegen.files import open_own

__all__ = [
    "UnsafePath",
    "allows_code",
    "check_private_file",
    "locked",
    "private_directory",
    "sweep_away",
    "temporary_private_directory",
]

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class UnsafePath(Exception):
    """Someone else can write here, or could put something else in its place."""


def private_directory(path: Path) -> Path:
    """The directory without symbolic links in its path, created with mode 0700 if it is missing.

    Raises
    ------
    UnsafePath : it is a link, belongs to someone else, is writable by group or others, or a directory above
        it lets others replace it.
    OSError : it cannot be created or read.
    """
    if path.is_symlink():
        raise UnsafePath(f"{path} is a symbolic link; give the directory itself")
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        path.mkdir(mode=0o700)
    path = path.parent.resolve() / path.name
    _check(path, os.lstat(path), stat.S_ISDIR, "directory")
    if not os.access(path, os.W_OK | os.X_OK):
        raise UnsafePath(f"{path} is read-only; set IMPACTOPT_CACHE to a directory that you can write")
    for above in path.parents:
        status = os.stat(above)
        if status.st_uid not in (0, os.getuid()):
            raise UnsafePath(f"{above}, above {path}, belongs to another user; use a directory of your own")
        # the sticky bit (as on /tmp) keeps others from renaming what is not theirs
        writable = status.st_mode & (stat.S_IWOTH if _is_own_group(status.st_gid) else _OTHERS_WRITE)
        if writable and not status.st_mode & stat.S_ISVTX:
            raise UnsafePath(f"{above}, above {path}, is writable by others; run: chmod go-w {above}")
    return path


def check_private_file(path: Path) -> None:
    """UnsafePath unless `path` is a plain file that only this user can write; OSError if missing."""
    _check(path, os.lstat(path), stat.S_ISREG, "file")


@contextlib.contextmanager
def locked(path: Path, *, on_wait: Callable[[], None]) -> Iterator[None]:
    """Hold a lock on `path` between processes; `on_wait` is called if another one holds it.

    Raises
    ------
    UnsafePath : it is no plain file, or cannot be made.
    """
    import fcntl  # POSIX only, as compiling is

    try:
        handle = open_own(path, os.O_RDWR | os.O_CREAT, 0o600)
    except OSError as error:
        raise UnsafePath(f"{path} cannot be locked: {error.strerror}") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_wait()
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def allows_code(path: Path) -> bool:
    """True if libraries can be loaded from a directory: its file system is not mounted noexec."""
    return not os.statvfs(path).f_flag & getattr(os, "ST_NOEXEC", 0)


def sweep_away(directory: Path, patterns: Sequence[str], older: float) -> None:
    """Remove what killed processes have left: files and directories of these names, older than that [s]."""
    past = time.time() - older
    for path in itertools.chain.from_iterable(map(directory.glob, patterns)):
        with contextlib.suppress(OSError):
            status = os.lstat(path)
            if status.st_mtime < past:
                if stat.S_ISDIR(status.st_mode):
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()


@functools.cache
def temporary_private_directory() -> Path:
    """A directory (mode 0700) that lives as long as this process."""
    path = Path(tempfile.mkdtemp(prefix="impactopt-"))
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    return path


def _check(path: Path, status: os.stat_result, is_kind: Callable[[int], bool], kind: str) -> None:
    if not is_kind(status.st_mode):
        raise UnsafePath(f"{path} is not a plain {kind}; remove it")
    if status.st_uid != os.getuid():
        raise UnsafePath(
            f"{path} belongs to another user; remove it, or set IMPACTOPT_CACHE to a directory of your own"
        )
    if status.st_mode & _OTHERS_WRITE:
        raise UnsafePath(f"{path} is writable by others; run: chmod go-w {path}")


def _is_own_group(group: int) -> bool:
    """True if the group is this user's alone, as where every user has a group of the same name."""
    import grp
    import pwd

    try:
        user = pwd.getpwuid(os.getuid())
        entry = grp.getgrgid(group)
    except KeyError:
        return False
    return user.pw_gid == group and entry.gr_name == user.pw_name and set(entry.gr_mem) <= {user.pw_name}
