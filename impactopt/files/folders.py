"""Locations of the package's own files; a module without heavy imports, for shell completion.

In git they are in `problems/` beside the package; a wheel has them inside it, in `_problems`.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["FOLDERS", "SWEEPS", "named_files"]

SWEEPS = "sweeps"  # subfolder of the problems
_PACKAGE = Path(__file__).resolve().parents[1]
FOLDERS = (_PACKAGE / "_problems", _PACKAGE.parent / "problems")


def named_files(inside: str = "") -> dict[str, Path]:
    """Paths of the problem files by name, sorted; inside : a subfolder."""
    folder = next((folder for folder in FOLDERS if folder.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted((folder / inside).glob("*.toml"))}
