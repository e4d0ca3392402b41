"""Descriptions of keys and sections, for comments in files and for the reference."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from impactopt.files.problem_file.contacts import with_kinds
from impactopt.files.problem_file.diagnostics import section_at
from impactopt.files.problem_file.sections import File
from impactopt.files.problem_file.toml import Place

__all__ = ["about_section", "comment_at"]


def about_section(section: type[BaseModel]) -> str:
    """Description of a section: its docstring's first sentence."""
    return " ".join((section.__doc__ or "").split("\n\n")[0].split()).rstrip(".")


def comment_at(data: Mapping[str, Any], place: Place) -> str:
    """The comment to a key or a section of a file with these data; "" where there is nothing to say."""
    section, sections = section_at(with_kinds(File, data), place)
    if sections == len(place):
        return about_section(section)
    for name, info in section.model_fields.items():
        if len(place) == sections + 1 and place[-1] in (info.alias, name):
            return info.description or ""
    return ""
