"""A problem file to start from: a problem by name, with a comment to each key and the keys it leaves out."""

from __future__ import annotations

from typing import Any

from impactopt.files.problem_file.contacts import with_kinds
from impactopt.files.problem_file.diagnostics import section_at
from impactopt.files.problem_file.key_docs import about_section, comment_at
from impactopt.files.problem_file.names import problem_file, problem_summary
from impactopt.files.problem_file.reading import read_problem_file
from impactopt.files.problem_file.section import Section
from impactopt.files.problem_file.sections import File
from impactopt.files.problem_file.term_sections import TermSections
from impactopt.files.problem_file.toml import Place, plain_value, write_toml

__all__ = ["problem_template"]


def problem_template(name: str) -> str:
    """The text of a named problem's file with all that can be said in its sections.

    Keys that the problem leaves out stand as comments with their defaults: whoever takes the # away has the
    same problem.

    Raises
    ------
    InputError : there is no problem of that name.
    """
    read = read_problem_file(problem_file(name))
    given = {"terms": {}, **read.data}
    data = {section: given[section] for section in File.model_fields if section in given}

    def hidden(place: Place) -> dict[str, Any]:
        section, sections = section_at(with_kinds(File, data), place)
        if sections != len(place) or not issubclass(section, Section):
            return {}
        table: Any = data
        for part in place:
            table = table[part]
        usual = section.defaults()
        keys = {f: info.alias or f for f, info in section.model_fields.items() if f != section.choice}
        left = {f: key for f, key in keys.items() if key not in table and usual.get(f) not in (None, ())}
        return {key: _short(f, plain_value(usual[f])) for f, key in left.items() if _is_value(usual[f])}

    head = (
        f"# {problem_summary(name)}.",
        f"# From `impactopt new {name}`; `impactopt check FILE` says what is wrong in a changed file.",
        "# A key that is commented out shows its default.",
    )
    text = write_toml(data, lambda place: comment_at(data, place), hidden)
    return "\n".join([*head, "", text.rstrip("\n"), "", *_left_out(data), ""])


def _short(field: str, value: Any) -> Any:
    return value[0] if field == "duration" and value[0] == value[1] else value


def _is_value(value: Any) -> bool:
    return isinstance(value, (bool, int, float, str, tuple, list))


def _left_out(data: dict[str, Any]) -> list[str]:
    """Sections that are not there, in a word each."""
    found = [(name, info) for name, info in File.model_fields.items() if name not in data]
    found += [
        (f"terms.{name}", info)
        for name, info in TermSections.model_fields.items()
        if name not in data["terms"]
    ]
    lines = ["# There may be more sections; `impactopt new --reference` says what is in them:"]
    for name, info in found:
        kind: Any = info.annotation
        many = not isinstance(kind, type)
        section = kind.__args__[0] if many else kind
        if name != "robot":
            lines.append(f"#   {f'[[{name}]]' if many else f'[{name}]'}  {about_section(section)}")
    return lines
