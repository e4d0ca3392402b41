"""What all sections of a problem file have in common."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, model_validator


def optional(key: str | None = None) -> Any:
    """A key that may be left out; the class that is built has the default."""
    return Field(default=None, alias=key)


class Section(BaseModel):
    """A section; unknown keys, NaN, infinity and text where a number belongs are refused.

    kind : the class that it describes.  choice : the field that only says which kind of section this is.
    """

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
    kind: ClassVar[Any] = None
    choice: ClassVar[str] = ""

    def given(self) -> dict[str, Any]:
        """The keys that the file has, by the names of the class's fields."""
        return self.model_dump(exclude_unset=True, exclude={self.choice})

    def build(self) -> Any:
        """The thing that this section describes."""
        return self.kind(**self.given())

    @model_validator(mode="after")
    def _can_be_built(self) -> Section:
        if self.kind is not None:
            self.build()
        return self
