"""Locations of the files that come with the package; a light module, as shell completion imports it.

In git they are in `problems/` beside the package; a wheel has them inside it, in `_problems`.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["FOLDERS", "SWEEPS", "named_files"]

SWEEPS = "sweeps"  # the folder among the problems
_PACKAGE = Path(__file__).resolve().parents[1]
FOLDERS = (_PACKAGE / "_problems", _PACKAGE.parent / "problems")


def named_files(inside: str = "") -> dict[str, Path]:
    """The problem files by name, in order; with a folder's name those inside it."""
    folder = next((folder for folder in FOLDERS if folder.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted((folder / inside).glob("*.toml"))}
