"""The sections [target] and [contact]: which keys they have depends on the kind of target and of law."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, ClassVar, TypeVar, cast

from pydantic import ConfigDict, Field, create_model

from impactopt.bodies.shapes import TargetBody
from impactopt.contact import laws, targets
from impactopt.files.problem_file.field_sections import one_of, section_of
from impactopt.files.problem_file.section import Section, optional

_FIRST_TARGET, _FIRST_LAW = targets.TARGETS[0].word, laws.LAWS[0].word  # of a file that names none
TargetKind: Any = one_of(kind.word for kind in targets.TARGETS)
LawKind: Any = one_of(kind.word for kind in laws.LAWS)


Body: Any = section_of(TargetBody)


class Target(Section):
    """Target of the impact; the keys depend on its kind."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "target_kind"
    apart: ClassVar[tuple[str, ...]] = ("body",)
    target_kind: TargetKind = Field(default=_FIRST_TARGET, alias="kind", description="what it is")
    body: Body = optional("")


class _KnownTarget(Target):
    """One whose keys are its own."""

    model_config = ConfigDict(extra="forbid")


class Contact(Section):
    """Contact between hand and target; the keys depend on the law."""

    model_config = ConfigDict(extra="ignore")
    choice: ClassVar[str] = "law"
    law: LawKind = Field(default=_FIRST_LAW, description="what gives the force")


class _KnownContact(Contact):
    """One whose keys are its own."""

    model_config = ConfigDict(extra="forbid")


TARGETS: dict[str, type[Target]] = {kind.word: section_of(kind, _KnownTarget) for kind in targets.TARGETS}
LAWS: dict[str, type[Contact]] = {kind.word: section_of(kind, _KnownContact) for kind in laws.LAWS}

File = TypeVar("File", bound=Section)


def with_kinds(file: type[File], data: Mapping[str, Any]) -> type[File]:
    """The model of a file whose [target] and [contact] are of the kinds that its data name."""
    found = {
        "target": _chosen(data, "target", "kind", TARGETS, Target, _FIRST_TARGET),
        "contact": _chosen(data, "contact", "law", LAWS, Contact, _FIRST_LAW),
    }
    return cast(type[File], _file_with(file, found["target"], found["contact"]))


@cache  # a sweep reads thousands
def _file_with(file: type[Section], target: type[Section], contact: type[Section]) -> type[Section]:
    fields: dict[str, Any] = {"target": (target, ...), "contact": (contact, ...)}
    return create_model(file.__name__, __base__=file, **fields)


def _chosen(
    data: Mapping[str, Any],
    section: str,
    key: str,
    kinds: Mapping[str, type[Section]],
    unknown: type[Section],
    default: str,
) -> type[Section]:
    given = data.get(section)
    name = given.get(key, default) if isinstance(given, Mapping) else default
    return kinds.get(name, unknown) if isinstance(name, str) else unknown
