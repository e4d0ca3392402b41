"""Files and directories that only this user can write, written whole; directories for compiled functions."""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import hashlib
import io
import itertools
import os
import secrets
import shutil
import stat
import tempfile
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any

from impactopt.errors import CacheWarning, InputError

_NONBLOCK = getattr(os, "O_NONBLOCK", 0)  # a pipe without a writer, or a reader, would wait for one


def write_atomically(
    path: Path,
    write: Callable[[IO[bytes]], Any],
    *,
    mode: int = 0o666,
    before: Callable[[], object] | None = None,
) -> None:
    """Let `write` fill a new file beside `path` that takes its place: readers see the old or the new one.

    mode : of the new file, less what the process's umask takes away.
    before : what is to be done just before that, when nothing of the new file can fail any more.

    Raises
    ------
    OSError : it cannot be written; what was at `path` before is still there, and nothing beside it.
    """
    # A name that nobody can guess, and one that is not there yet ("x" is O_EXCL): no link is followed. As of
    # tempfile.mkstemp, but with the permissions of any other new file.
    temporary = path.with_name(f".{path.name[:64]}.{secrets.token_hex(8)}.tmp")
    try:
        with open(temporary, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())  # a name that is there before its content would be an empty file
        if before is not None:
            before()
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def open_own(path: str | os.PathLike[str], flags: int, mode: int = 0o666) -> int:
    """A handle of a plain file that this program goes on with: a log, a journal, a lock.

    flags : of `os.open`, such as O_RDWR | O_CREAT; it fits `open` as its opener.

    Raises
    ------
    OSError : it is a link, a directory, a pipe or a device; or it cannot be opened.
    """
    return _plain(path, os.open(path, flags | getattr(os, "O_NOFOLLOW", 0) | _NONBLOCK, mode))


def read_plain(path: str | os.PathLike[str], most: int) -> bytes:
    """The content of a plain file of at most so many bytes; links are followed.

    Raises
    ------
    OSError : it is larger, a directory, a pipe or a device, which may never end; it cannot be read.
    """
    try:
        handle = _plain(path, os.open(path, os.O_RDONLY | _NONBLOCK))
    except ValueError:  # of a null byte
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), os.fspath(path)) from None
    with os.fdopen(handle, "rb") as file:
        # not at once: `read` takes memory for as much as it is asked for
        content = file.read(min(os.fstat(handle).st_size, most) + 1)
        content += file.read(most + 1 - len(content)) if len(content) <= most and file.peek(1) else b""
    if len(content) > most:
        raise OSError(errno.EFBIG, f"larger than {most / 2**20:g} MiB", os.fspath(path))
    return content


def read_archive(path: str | os.PathLike[str], most: int, arrays: int) -> io.BytesIO:
    """The content of an npz file, known to be small before NumPy unpacks it.

    most : bytes of the file, and of all that is in it unpacked.  arrays : at most so many, each with a name
    of its own.

    Raises
    ------
    OSError : as of `read_plain`.
    ValueError : it is larger when it is unpacked, or has more arrays, or two of the same name.
    zipfile.BadZipFile : it is no archive.
    """
    # from memory: np.load leaves a damaged file open
    content = io.BytesIO(read_plain(path, most))
    with zipfile.ZipFile(content) as archive:
        entries = archive.infolist()
    names = {entry.filename for entry in entries}
    if len(entries) > arrays or len(names) < len(entries):
        raise ValueError(f"{len(entries)} arrays, or two of the same name")
    if sum(entry.file_size for entry in entries) > most:
        raise ValueError(f"larger than {most / 2**20:g} MiB when it is unpacked")
    content.seek(0)
    return content


def is_plain_file(path: str | os.PathLike[str]) -> bool:
    """True if there is a plain file; false for names that no file can have, too."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):
        return False


def _plain(path: str | os.PathLike[str], handle: int) -> int:
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "not a plain file", os.fspath(path))
    return handle


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

    The system releases it however the process ends.

    Raises
    ------
    UnsafePath : it is no plain file, cannot be made, or is on a file system without locks.
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
        except OSError as error:
            raise UnsafePath(f"{path} cannot be locked: {error.strerror}") from error
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


# [s] from which on an unfinished compilation is one that was killed: no single function takes so long
_LEFT_BEHIND = 24 * 3600.0


def usable_directory() -> Path:
    """The cache, or where it cannot be used a directory of this process."""
    try:
        directory = private_directory(cache_directory())
        if not allows_code(directory):
            raise UnsafePath(
                f"{directory} is on a file system that no code can be loaded from (mounted noexec); set "
                "IMPACTOPT_CACHE to a directory elsewhere"
            )
        _sweep(directory)
        return directory
    except UnsafePath as error:
        _warn_temporary(str(error))
    except OSError as error:
        _warn_temporary(
            f"cannot use {cache_directory()}: {error.strerror}; set IMPACTOPT_CACHE to a directory that you "
            "can write"
        )
    return temporary_private_directory()


@functools.cache  # once a process
def _warn_temporary(reason: str) -> None:
    warn(f"{reason}; compiling into a temporary directory, for this process only")


@functools.cache  # once a process
def _sweep(directory: Path) -> None:
    sweep_away(directory, ("tmp-*", ".*.tmp"), older=_LEFT_BEHIND)


def kept(kind: str, digest: str, make: Callable[[], bytes]) -> bytes:
    """Numbers that take long to find: from the cache, or made and put there.

    kind, digest : what they are called, and a hash of all that they depend on.
    """
    path = usable_directory() / f"{slug(kind)}-{digest[:40]}"
    try:
        check_private_file(path)
        content = path.read_bytes()
        if hashlib.sha256(content[32:]).digest() == content[:32]:
            return content[32:]
    except (OSError, UnsafePath):
        pass  # not there yet
    made = make()
    with contextlib.suppress(OSError):  # a full disk: they are made again next time
        put(path, hashlib.sha256(made).digest() + made)
    return made


def cache_directory() -> Path:
    """Directory of compiled libraries: $IMPACTOPT_CACHE, $XDG_CACHE_HOME/impactopt or ~/.cache/impactopt.

    Who has no home, as users of containers may, has a directory of his own among the temporary ones.

    Raises
    ------
    InputError : IMPACTOPT_CACHE begins with the home of a user that there is not.
    """
    own, base = os.environ.get("IMPACTOPT_CACHE"), Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        if own:
            return Path(own).expanduser().absolute()
        home = Path.home()
    except RuntimeError as error:
        if own:
            raise InputError(f"IMPACTOPT_CACHE is {own!r}: {error}; give a directory") from None
        home = Path()
    if base.is_absolute():  # a relative one is to be ignored, as freedesktop.org's specification says
        return base / "impactopt"
    if home.is_absolute() and home != Path(home.anchor):
        return home / ".cache" / "impactopt"
    return Path(tempfile.gettempdir()).absolute() / f"impactopt-{os.getuid()}"


def put(path: Path, content: bytes, *, mode: int = 0o600) -> None:
    write_atomically(path, lambda file: file.write(content), mode=mode)


def warn(message: str) -> None:
    warnings.warn(f"cache of compiled functions: {message}", CacheWarning, stacklevel=3)


def slug(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)
