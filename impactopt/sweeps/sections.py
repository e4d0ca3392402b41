"""Sections of a sweep file, with their defaults and checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from impactopt.files.sections.diagnostics import Mistake
from impactopt.files.sections.values import Positive, Section, optional, required, usual


def flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Key paths and their values; TOML reads dots in keys as nested tables."""
    for key, what in table.items():
        if isinstance(what, Mapping) and not what.keys() & {"from", "to"}:
            yield from flat(what, f"{above}{key}.")
        else:
            yield f"{above}{key}", what


def put(table: dict[str, Any], key: str, value: Any) -> None:
    """Set the value of a key path; missing tables are made."""
    name, _, below = key.partition(".")
    if key in table or not below:  # a quoted key of the table may have dots
        table[key] = value
        return
    inner = table.get(name)
    table[name] = dict(inner) if isinstance(inner, Mapping) else {}
    put(table[name], below, value)


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


Names = Annotated[list[str], BeforeValidator(_listed)]
# what is no table is refused by its type
_FLAT = BeforeValidator(lambda table: dict(flat(table)) if isinstance(table, Mapping) else table)
Named = Annotated[dict[str, Any], _FLAT]
Levels = Annotated[dict[str, float], _FLAT]
Texts = Annotated[dict[str, str], _FLAT]


class Figure(Section):
    """Picture of a sweep; names are the sweep's keys, and columns of its table."""

    drawn_as: Literal["heatmap", "lines", "scatter"] = required("what is drawn", "kind")
    x: str = required("column on the horizontal axis")
    y: Names = required("column on the vertical axis; with lines one or several, each in a panel")
    colour: Names = usual(
        [], "of heatmaps one or several columns, each in a panel; of lines the columns that distinguish them"
    )
    panel: str | None = optional("of lines and scatters: a panel for each of its values")
    against: Named = usual(
        {}, "of lines: by key the value of the reference rows, which the others are compared with in per cent"
    )
    contour: Levels = usual({}, "of heatmaps: by column the level at which a line is drawn")
    log: list[Literal["x", "y", "colour"]] = usual([], "columns with logarithmic scales")
    labels: Texts = usual({}, "by the name of a column or line, the text in its place")
    title: str = usual("", "title above the picture")

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns in the figure."""
        panel = [] if self.panel is None else [self.panel]
        return tuple(dict.fromkeys([self.x, *self.y, *self.colour, *panel, *self.against, *self.contour]))

    def renamed(self, name: Callable[[str], str]) -> Figure:
        """Figure with other names for the columns."""

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


_KINDS = {"contour": ("heatmap",), "panel": ("lines", "scatter"), "against": ("lines",)}
MOST_CONTOURS = 3  # of a heatmap


def unused_in_figure(figure: Figure) -> list[Mistake]:
    """Mistakes: what the figure's kind does not draw."""
    kind, found = figure.drawn_as, dict[str, str]()
    for name, kinds in _KINDS.items():
        if getattr(figure, name) and kind not in kinds:
            found[name] = f"of kind = {' or '.join(map(repr, kinds))} only, not {kind!r}; leave it out"
    if len(figure.y) > 1 and kind != "lines":
        found["y"] = f"several are of kind = 'lines' only, not {kind!r}; give one"
    if len(figure.colour) > 1 and kind == "scatter":
        found["colour"] = "several are of kind = 'lines' or 'heatmap' only, not 'scatter'; give one"
    if len(figure.contour) > MOST_CONTOURS:
        found["contour"] = f"{len(figure.contour)} lines; give at most {MOST_CONTOURS}"
    return [Mistake(place=("figure", name), sections=1, text=text) for name, text in found.items()]


AtLeastOne = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=1, le=10_000_000)]  # of values, which are kept in memory
Seed = Annotated[int, Field(ge=0)]


class SweepSection(Section):
    """Kind of case, and its problem."""

    problem: str = required("a problem's name, or a file beside this one")
    name: str = usual("", "what reports call the sweep")
    case_kind: Literal["solve", "strike", "collision"] = usual(
        "solve", "a whole motion, the strike alone, or one collision"
    )
    seed: Seed = usual(0, "seed of what is drawn, and of solves from several starts")
    start: Literal["reach", "strike", "neighbour"] = usual(
        "reach",
        "initial guess of a solve: a plain reach, the strike alone, or the nearest case solved "
        "so far (a plain reach if there is none)",
    )
    starts: AtLeastOne = usual(1, "initial guesses of each solve or strike, of which the best is kept")
    time_limit: Positive = optional("time limit of the solver in each case [s]", "time_limit_s")
    trajectories: bool = usual(False, "keep the full result of each case")
    outputs: Annotated[tuple[str, ...], Field(strict=False)] = usual(
        ("impulse_Ns", "peak_force_N", "freeze_error_pct"), "columns of the table, of collisions"
    )


class SpanSection(Section):
    """Range of numbers."""

    first: float = required("the first", "from")
    last: float = required("the last, included", "to")
    count: Count | None = optional("number of values; not for drawn ones")
    scale: Literal["linear", "log"] = usual("linear", "equal steps (linear) or equal factors (log)")


class DrawSection(Section):
    """Points drawn over ranges."""

    method: Literal["random", "sobol", "latin hypercube"] = usual("sobol", "method of drawing")
    count: Count = required("number of points")
    over: dict[str, Any] = required("by key path, a range or a list to choose from")


class SweepFile(Section):
    """A sweep file; keys below [set], [grid], [list] and [draw.over] are the problem file's."""

    sweep: SweepSection
    at_contact: dict[str, Any] = usual({}, "state at contact, of collisions")
    set: dict[str, Any] = usual({}, "values that are the same in every case")
    grid: dict[str, Any] = usual({}, "values of which every combination is a case")
    list: dict[str, Any] = usual({}, "lists of equal length, whose values at the same index are a case")
    draw: DrawSection = optional("drawn values")
    figure: Figure | None = optional("picture of the table")


def of_other_kinds(content: SweepFile) -> list[Mistake]:
    """Mistakes: settings in the file that do not apply to the sweep's kind of case."""
    given, found = content.sweep, list[Mistake]()
    collisions = given.case_kind == "collision"
    for name in sorted(given.model_fields_set):
        key = SweepSection.model_fields[name].alias or name
        if collisions and name in ("start", "starts", "time_limit", "trajectories"):
            found.append(Mistake(place=("sweep", key), sections=1, text="collisions have none; leave it out"))
        if not collisions and name == "outputs":
            text = "of collisions only; all numbers of a solve are kept"
            found.append(Mistake(place=("sweep", key), sections=1, text=text))
    if given.start == "neighbour" and given.case_kind == "strike":
        text = '"neighbour" is of case_kind = "solve" only'
        found.append(Mistake(place=("sweep", "start"), sections=1, text=text))
    if given.start == "neighbour" and given.starts > 1:
        text = 'a case starts from one neighbour: leave it out, or give start = "reach"'
        found.append(Mistake(place=("sweep", "starts"), sections=1, text=text))
    if content.at_contact and not collisions:
        found.append(Mistake(place=("at_contact",), sections=1, text='of case_kind = "collision" only'))
    return found
