"""Base class of all sections of a problem file."""

from __future__ import annotations

import inspect
import re
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator


def optional(about: str, key: str | None = None) -> Any:
    """A key that may be left out; the class that is built has the default.

    about : what it is, with its unit in brackets.  key : its name in the file, if a unit belongs to it.
    """
    return Field(default=None, alias=key, description=about)


def required(about: str, key: str | None = None) -> Any:
    """A key that has to be there; see `optional`."""
    return Field(alias=key, description=about)


def attribute_docs(kind: type) -> dict[str, str]:
    """Description of each attribute in the docstrings of a class and its bases, on one line; `a, b : text`
    describes both.
    """
    out: dict[str, str] = {}
    for each in reversed(kind.__mro__):
        said = inspect.cleandoc(each.__doc__ or "")  # Python 3.13 takes the margin away, older ones keep it
        section = re.split(r"\nAttributes\n-+\n", said)[-1]
        entries = re.split(r"\n(?=[a-z_]+(?: \[\w+\])?(?:, [a-z_]+(?: \[\w+\])?)* : )", "\n" + section)
        for entry in entries[1:]:
            names, _, text = entry.partition(" : ")
            for name in names.split(","):
                out[name.split()[0]] = " ".join(text.split()).rstrip(".")
    return out


class Section(BaseModel):
    """A section; unknown keys, NaN, infinity and text where a number belongs are refused.

    Of a class below, the docstring's first sentence says in the reference what the section is about.
    kind : the class that it describes.  choice : the field that only says which kind of section this is.
    apart : fields that are sections of something else.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    kind: ClassVar[Any] = None
    choice: ClassVar[str] = ""
    apart: ClassVar[tuple[str, ...]] = ()

    def given(self) -> dict[str, Any]:
        """The keys that the file has, by the names of the class's fields."""
        return self.model_dump(exclude_unset=True, exclude={self.choice, *self.apart})

    def build(self) -> Any:
        """The thing that this section describes."""
        return self.kind(**self.given())

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Default values of optional keys, by field; a field without a default is not in it."""
        if not is_dataclass(cls.kind):
            return {}
        made = {f.name: f.default_factory() for f in fields(cls.kind) if f.default_factory is not MISSING}
        return made | {f.name: f.default for f in fields(cls.kind) if f.default is not MISSING}

    @model_validator(mode="after")
    def _can_be_built(self) -> Section:
        if self.kind is not None:
            self.build()
        return self
