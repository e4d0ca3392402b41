"""The directive `commands`: what `impactopt NAME --help` prints, a section a command.

Its arguments are the commands that are left out.
"""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from typer.main import get_command

from impactopt.cli.app import app as cli


def entries(command: Any) -> list[tuple[str, str]]:
    """Arguments and options of a command, as they are typed, with what they do."""
    found = []
    for parameter in command.params:
        if parameter.param_type_name == "option":
            default = parameter.default
            known = default is not None and not callable(default) and default not in (False, True, "", ())
            typed = ", ".join([*parameter.opts, *parameter.secondary_opts])
            tail = f" Default: {getattr(default, 'value', default)}." if known else ""
            found.append((typed, (parameter.help or "") + tail))
        else:
            found.append(
                ((parameter.metavar or parameter.name).upper(), getattr(parameter, "help", None) or "")
            )
    return found


class Commands(SphinxDirective):
    optional_arguments = 100

    def run(self) -> list[nodes.Node]:
        root: Any = get_command(cli)
        sections: list[nodes.Node] = []
        for name in sorted(set(root.commands) - set(self.arguments)):
            command = root.commands[name]
            section = nodes.section(ids=[f"impactopt-{name}"])
            section += nodes.title("", "", nodes.literal("", f"impactopt {name}"))
            lines = [*(command.help or "").splitlines(), ""]
            for typed, meaning in entries(command):
                lines += [f"`{typed}`", f": {meaning}", ""]
            self.state.nested_parse(StringList(lines, source="--help"), self.content_offset, section)
            sections.append(section)
        return sections


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
