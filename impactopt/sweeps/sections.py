"""The sections of a sweep file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from impactopt.problem_file.mistakes import Mistake
from impactopt.problem_file.section import Section, optional
from impactopt.problem_file.values import Positive

__all__ = ["File", "Grain", "SpanSection", "of_other_grains"]

Grain = Literal["solve", "strike", "collision"]
AtLeastOne = Annotated[int, Field(ge=1)]


class SweepSection(Section):
    problem: str
    name: str = ""
    grain: Grain = "solve"
    seed: Annotated[int, Field(ge=0)] = 0
    start: Literal["reach", "strike"] = "reach"
    starts: AtLeastOne = 1
    time_limit: Positive = optional("time_limit_s")
    trajectories: bool = False
    outputs: Annotated[tuple[str, ...], Field(strict=False)] = ("impulse_Ns", "peak_force_N")


class SpanSection(Section):
    first: float = Field(alias="from")
    last: float = Field(alias="to")
    count: AtLeastOne | None = optional()
    scale: Literal["linear", "log"] = "linear"


class DrawSection(Section):
    method: Literal["random", "sobol", "latin hypercube"] = "sobol"
    count: AtLeastOne
    over: dict[str, Any]


class File(Section):
    """A sweep file; keys below [set], [grid], [list] and [draw.over] are the problem file's.

    at_contact : of collisions, `impactopt.sweeps.at_contact`; what it leaves open can be varied too.
    """

    sweep: SweepSection
    at_contact: dict[str, Any] = Field(default_factory=dict)
    set: dict[str, Any] = Field(default_factory=dict)
    grid: dict[str, Any] = Field(default_factory=dict)
    list: dict[str, Any] = Field(default_factory=dict)
    draw: DrawSection = optional()


def of_other_grains(content: File) -> list[Mistake]:
    """What the file says and the sweep's grain has no use for."""
    given, found = content.sweep, list[Mistake]()
    collisions = given.grain == "collision"
    for name in sorted(given.model_fields_set):
        key = SweepSection.model_fields[name].alias or name
        if collisions and name in ("start", "starts", "time_limit", "trajectories"):
            found.append(Mistake(place=("sweep", key), sections=1, text="collisions have none; leave it out"))
        if not collisions and name == "outputs":
            text = "of collisions only; all numbers of a solve are kept"
            found.append(Mistake(place=("sweep", key), sections=1, text=text))
    if content.at_contact and not collisions:
        found.append(Mistake(place=("at_contact",), sections=1, text='of grain = "collision" only'))
    return found
