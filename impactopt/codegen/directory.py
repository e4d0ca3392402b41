"""Directories on disk for compiled functions, and for cached numbers that take long to compute."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

from impactopt.codegen.files import write_atomically
from impactopt.codegen.private_files import (
    UnsafePath,
    allows_code,
    check_private_file,
    private_directory,
    sweep_away,
    temporary_private_directory,
)
from impactopt.errors import CacheWarning, InputError

__all__ = ["cache_directory", "kept", "put", "slug", "usable_directory", "warn"]

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
    except (UnsafePath, OSError) as error:
        warn(f"{error}; compiling into a temporary directory, for this process only")
        return temporary_private_directory()


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
