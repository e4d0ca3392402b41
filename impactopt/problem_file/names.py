"""Problems by name: the files that come with the package."""

from __future__ import annotations

import os
from pathlib import Path

from impactopt._folders import FOLDERS
from impactopt.errors import InputError, did_you_mean

__all__ = ["problem_file", "problem_names", "problem_summary"]


def problem_names() -> tuple[str, ...]:
    """Names of the problems that come with the package, as `load_problem` takes them."""
    return tuple(sorted(_named()))


def problem_file(name: str | os.PathLike[str]) -> Path:
    """The file of a problem's name; a path to a file is returned as it is.

    A path has a folder or a suffix, or there is a file of that name; what is neither has to be a name.

    Raises
    ------
    InputError : an unknown name.
    """
    path = Path(name)
    if path.suffix or len(path.parts) != 1 or path.is_file():
        return path
    named = _named()
    if path.name not in named:
        raise InputError(
            f"there is no problem {path.name!r}{did_you_mean(path.name, named)}; problems are "
            f"{', '.join(sorted(named))}; or give the path of a file"
        )
    return named[path.name]


def problem_summary(name: str) -> str:
    """What a named problem is about: the first sentence of its file's comment."""
    words: list[str] = []
    for line in problem_file(name).read_text(encoding="utf-8").splitlines():
        if not line.startswith("# "):
            break
        words.append(line.removeprefix("# "))
    return " ".join(words).split(". ")[0].rstrip(".:")


def _named() -> dict[str, Path]:
    folder = next((folder for folder in FOLDERS if folder.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in folder.glob("*.toml")}
