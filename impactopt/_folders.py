"""Where the problem files are that come with the package; light, as completion in the shell waits for it.

In git they are in `problems/` beside the package; a wheel has them inside it, in `_problems`.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["FOLDERS"]

_PACKAGE = Path(__file__).resolve().parent
FOLDERS = (_PACKAGE / "_problems", _PACKAGE.parent / "problems")
