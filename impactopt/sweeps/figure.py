"""Section [figure] of a sweep file: which columns of the table are drawn, and how."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from impactopt.files.problem_file.section import Section, optional, required
from impactopt.sweeps.key_paths import flat

__all__ = ["Figure"]


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_listed)]
Named = Annotated[dict[str, Any], BeforeValidator(lambda table: dict(flat(table)))]
Levels = Annotated[dict[str, float], BeforeValidator(lambda table: dict(flat(table)))]
Texts = Annotated[dict[str, str], BeforeValidator(lambda table: dict(flat(table)))]


class Figure(Section):
    """Picture of a sweep; names are the sweep's keys, and columns of its table."""

    drawn_as: Literal["heatmap", "lines", "scatter"] = required("what is drawn", "kind")
    x: str = required("column on the horizontal axis")
    y: Names = required("column on the vertical axis; with lines one or several, each in a panel")
    colour: Names = Field(
        default_factory=list,
        description="of heatmaps one or several, each in a panel; of lines what tells them apart",
    )
    panel: str | None = optional("of lines and scatters: a panel for each of its values")
    against: Named = Field(
        default_factory=dict,
        description="of lines: by key the value of the rows that the others are held against, in per cent",
    )
    contour: Levels = Field(
        default_factory=dict, description="of heatmaps: by column the level at which a line is drawn"
    )
    log: list[Literal["x", "y", "colour"]] = Field(
        default_factory=list, description="columns with logarithmic scales"
    )
    labels: Texts = Field(
        default_factory=dict, description="by name, or by what a line is called, other words for it"
    )
    title: str = Field(default="", description="title above the picture")

    @property
    def columns(self) -> tuple[str, ...]:
        """All that it names."""
        panel = [] if self.panel is None else [self.panel]
        return tuple(dict.fromkeys([self.x, *self.y, *self.colour, *panel, *self.against, *self.contour]))

    def renamed(self, name: Callable[[str], str]) -> Figure:
        """The same with other names for the columns."""

        def keys(table: Mapping[str, Any]) -> dict[str, Any]:
            return {name(key): value for key, value in table.items()}

        new = {
            "x": name(self.x),
            "y": [name(y) for y in self.y],
            "colour": [name(c) for c in self.colour],
            "panel": None if self.panel is None else name(self.panel),
            "against": keys(self.against),
            "contour": keys(self.contour),
            "labels": keys(self.labels),
        }
        return self.model_copy(update=new)
