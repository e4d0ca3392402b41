"""Writes files whole and through no planted link, and reads files that could be anything."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import secrets
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

__all__ = ["is_plain_file", "open_own", "read_archive", "read_plain", "write_atomically"]

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
