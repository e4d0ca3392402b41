"""One HTML file with all in it: style, scripts and numbers. It asks nothing of any network."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from typing import Any

from numpy.typing import NDArray

from impactopt import __version__
from impactopt.report.pack import pack

__all__ = ["html_page"]

# in this order: each uses what is in those before it
SCRIPTS = ("unpack", "geometry", "view", "player", "charts", "main")


def html_page(
    *, title: str, kind: str, body: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> str:
    """The page; `body` is HTML, `title` is text; kind: "report", or "alone" for an animation by itself."""
    scripts = "\n".join(_asset(f"{name}.js") for name in SCRIPTS)
    given = {
        "generator": f"impactopt {__version__}",
        "title": escape(title),
        "kind": kind,
        "style": _asset("style.css"),
        "body": body,
        "numbers": pack(header, arrays),
        "scripts": scripts,
    }
    page = _asset("page.html")
    # in one pass: what is put in may have such marks in it
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: given[mark.group(1)], page)


def _asset(name: str) -> str:
    return files("impactopt.report").joinpath("assets").joinpath(name).read_text(encoding="utf-8")
