"""The package's own problem and sweep files by name; a module without heavy imports, for shell completion.

In git they are in `problems/` beside the package; a wheel has them inside it, in `_problems`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from impactopt.codegen.files import is_plain_file
from impactopt.errors import InputError, did_you_mean, shortened

SWEEPS = "sweeps"  # subfolder of the problems
_PACKAGE = Path(__file__).resolve().parents[1]
FOLDERS = (_PACKAGE / "_problems", _PACKAGE.parent / "problems")


def named_files(inside: str = "") -> dict[str, Path]:
    """Paths of the problem files by name, sorted; inside : a subfolder."""
    folder = next((folder for folder in FOLDERS if folder.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted((folder / inside).glob("*.toml"))}


def problem_names() -> tuple[str, ...]:
    """Names of the package's problems, arguments of `load_problem`."""
    return tuple(named_files())


def problem_file(name: str | os.PathLike[str]) -> Path:
    """The file of a problem's name; a path to a file is returned unchanged.

    An argument with a folder or a suffix, or of an existing file, is a path; all else is a name.

    Raises
    ------
    InputError : an unknown name.
    """
    return _file(name, named_files(), "problem")


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
    try:
        path = Path(name)
    except TypeError:
        text = "; `write_problem` gives the text of a problem's file" if kind == "problem" else ""
        raise InputError(
            f"a {kind} is given by its name or its file, and this is of type {type(name).__name__}{text}"
        ) from None
    if path.suffix or len(path.parts) != 1 or is_plain_file(path):
        if str(path) == f"{path.stem}.toml" and path.stem in named and not path.exists():
            raise InputError(
                f"there is no file {path} here; the package's {kind} is named {path.stem!r}, and is the file "
                f"{named[path.stem]}"
            )
        return path
    if path.name not in named:
        raise InputError(
            f"there is no {kind} {shortened(path.name)!r}{did_you_mean(path.name, named)}; {kind}s are "
            f"{', '.join(named)}; or give the path of a file"
        )
    return named[path.name]
