"""Problems, robots and sweeps by name: the files that come with the package."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, did_you_mean, shortened

__all__ = [
    "FOLDERS",
    "SWEEPS",
    "named_files",
    "problem_file",
    "problem_names",
    "problem_summary",
    "sweep_file",
    "sweep_names",
]

SWEEPS = "sweeps"  # the folder among the problems
_PACKAGE = Path(__file__).resolve().parents[2]
FOLDERS = (_PACKAGE / "_problems", _PACKAGE.parent / "problems")


def named_files(inside: str = "") -> dict[str, Path]:
    """The problem files by name, in order; with a folder's name those inside it."""
    folder = next((folder for folder in FOLDERS if folder.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted((folder / inside).glob("*.toml"))}


def problem_names() -> tuple[str, ...]:
    """Names of the problems that come with the package, as `load_problem` takes them."""
    return tuple(named_files())


def problem_file(name: str | os.PathLike[str]) -> Path:
    """The file of a problem's name; a path to a file is returned as it is.

    A path has a folder or a suffix, or there is a file of that name; what is neither has to be a name.

    Raises
    ------
    InputError : an unknown name.
    """
    return _file(name, named_files(), "problem")


def sweep_names() -> tuple[str, ...]:
    """Names of the sweeps that come with the package, as `read_sweep_file` takes them."""
    return tuple(named_files(SWEEPS))


def sweep_file(name: str | os.PathLike[str]) -> Path:
    """The file of a sweep's name, as `problem_file` of a problem's."""
    return _file(name, named_files(SWEEPS), "sweep")


def problem_summary(name: str) -> str:
    """Summary of a named problem: the first sentence of its file's comment."""
    words: list[str] = []
    for line in problem_file(name).read_text(encoding="utf-8").splitlines():
        if not line.startswith("# "):
            break
        words.append(line.removeprefix("# "))
    return " ".join(words).split(". ")[0].rstrip(".:")


def _file(name: str | os.PathLike[str], named: Mapping[str, Path], kind: str) -> Path:
    path = Path(name)
    if path.suffix or len(path.parts) != 1 or is_plain_file(path):
        return path
    if path.name not in named:
        raise InputError(
            f"there is no {kind} {shortened(path.name)!r}{did_you_mean(path.name, named)}; {kind}s are "
            f"{', '.join(named)}; or give the path of a file"
        )
    return named[path.name]
