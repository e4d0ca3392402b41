"""Reports of a result: tables and plain messages on the terminal, pictures, a page for a browser.

The terminal's modules (console, result_rows, plain_errors) are light to load, so the page's names are
imported when they are used.
"""

from __future__ import annotations

import importlib
from typing import Any

_EXPORTS = {
    "Animation": "animation",
    "Report": "report",
    "animate": "animation",
    "animation_of": "animation",
    "bodies_page": "robot_page",
    "bodies_page_of_problem": "robot_page",
    "report_of": "report",
    "report_page": "report",
}


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'impactopt.report' has no attribute {name!r}")
    return getattr(importlib.import_module(f"impactopt.report.{_EXPORTS[name]}"), name)
