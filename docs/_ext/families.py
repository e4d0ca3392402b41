"""The directive `family`: the reference of all that a table of the package lists.

`.. family:: impactopt.contact.laws LAWS` is an `autoclass` for each of LAWS; a table may hold classes,
objects, which stand for their classes, or functions by name. What a second table has too is left out.
"""

from __future__ import annotations

import importlib

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


def members(module: str, table: str) -> list[str]:
    """Names of the classes or functions that a table of a module lists, in its order."""
    listed = getattr(importlib.import_module(module), table)
    if isinstance(listed, dict):
        return list(listed)
    return [(one if isinstance(one, type) else type(one)).__name__ for one in listed]


class Family(SphinxDirective):
    required_arguments = 2
    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        module, table, *besides = self.arguments
        without = {name for other in besides for name in members(module, other)}
        names = [name for name in members(module, table) if name not in without]
        kind = "autoclass" if names[0][0].isupper() else "autofunction"
        found = nodes.container()
        lines = [line for name in names for line in (f".. {kind}:: impactopt.{name}", "")]
        self.state.nested_parse(StringList(lines, source=module), self.content_offset, found)
        return found.children


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("family", Family)
    return {"parallel_read_safe": True}
