"""Docstrings in the house's style, for Sphinx: entries, `name [unit] : what it is`, become lists."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

BARS = re.compile(r"(`[^`]*`)|\|")  # of a value's size: to Sphinx a substitution
ARRAY = re.compile(r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[[^]]*\]\]")
ARRAY_LIKE = re.compile(r"~?[\w.]*_Buffer \| .*?\| [\w.~]*_NestedSequence\[complex \| bytes \| str\]")
UNDERLINE = re.compile(r"-{3,}$")
ENTRY = re.compile(r"(?P<name>[\w`*.(\[{][^:]{0,60}?) ?: (?P<what>.*)$")  # in a section
LOOSE = re.compile(r"(?P<name>[\w`*][^:]{0,60}?) : (?P<what>.*)$")  # outside of one


def listed(lines: list[str]) -> list[str]:
    """The lines with underlined sections as rubrics, and their entries, or those without one, as lists."""
    out: list[str] = []
    section = entry = False
    for here, line in enumerate(lines):
        following = lines[here + 1] if here + 1 < len(lines) else ""
        if UNDERLINE.match(line):
            continue
        if UNDERLINE.match(following) and line.strip():
            out += ["", f".. rubric:: {line.strip()}", ""]
            section = True
        elif found := (ENTRY if section else LOOSE).match(line):
            out += [] if entry else [""]
            out.append(f"* **{found['name'].replace('`', '')}**: {found['what']}")
            entry = True
        elif entry and line.startswith(" "):
            out.append("  " + line.strip())
        else:
            out += [""] if entry else []
            out.append(line)
            entry = False
    return out


def signed(text: str | None) -> str | None:
    """A signature that Sphinx can parse, and a person read: arrays as such, a made default as dots."""
    if not text:
        return text
    return ARRAY_LIKE.sub("ArrayLike", ARRAY.sub("Array", text)).replace("<factory>", "...")


def process(app: Sphinx, what: str, name: str, obj: object, options: Any, lines: list[str]) -> None:
    lines[:] = [BARS.sub(lambda found: found[1] or r"\|", line) for line in listed(lines)]


def sign(
    app: Sphinx, what: str, name: str, obj: object, options: Any, args: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    return signed(args), signed(returns)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-signature", sign)
    app.connect("autodoc-process-docstring", process)
    return {"parallel_read_safe": True}
