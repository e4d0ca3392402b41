"""Picture of a sweep's table, by the [figure] of its file: a heatmap, lines or a scatter plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter

from impactopt.arrays import Array, Index
from impactopt.errors import InputError
from impactopt.files.output import write_file
from impactopt.report.pictures.style import BLACK, COLOURS, PAGE, Picture, model_colour, styled
from impactopt.report.pictures.sweep_columns import (
    Columns,
    SweepColumns,
    combined,
    errors_against,
    name_of_error,
)
from impactopt.sweeps.definition import Sweep
from impactopt.sweeps.sections import Figure as Section
from impactopt.sweeps.table import read_columns, read_units

MARKS = ("o", "s", "^", "D", "v", "P", "X")
NO_RESULT = "#d9d9d9"  # colour of cases without a result
MAX_MARKED = 25  # points of a line that are marked; longer lines have no marks
MAX_LISTED = 8  # shades in a legend; of more, some are listed
LEGEND_WIDTH, HANDLE_WIDTH = 120, 8  # characters of a row of the legend, and of the mark before a label
MAX_POINTS = 20_000  # of a scatter plot: more are no clearer
SCALE = "cividis"
MODEL, FREEZES = "at_contact.model", "at_contact.freezes"
DASHES: Any = ("-", "--", ":")  # of contours
_PLAIN = FuncFormatter(lambda x, _: _number(x))


def save_sweep_picture(sweep: Sweep, table: Path) -> Path | None:
    """Draws a sweep's table into ``figure.png`` beside it; None if the sweep has no [figure].

    Raises
    ------
    InputError : as in `sweep_picture`; a missing column; a file that cannot be read or written.
    """
    if sweep.figure is None:
        return None
    path, picture = table.with_name("figure.png"), drawn_table(sweep.figure, table)
    write_file(path, picture.write)
    return path


def drawn_table(section: Section, table: Path) -> Picture:
    """Picture of a table's file, as `sweep_picture`."""
    return sweep_picture(section, read_columns(table, (*section.columns, "reason")), read_units(table))


@styled
def sweep_picture(section: Section, columns: Columns, units: Mapping[str, str] | None = None) -> Picture:
    """Picture of a sweep's table.

    columns : of the table by name: those that `section` names, and `reason`.  units : of the columns; None:
    those in their names.

    Raises
    ------
    InputError : a heatmap of cases that form no grid; columns that must be numbers and are not; no reference
        cases for errors.
    """
    data = SweepColumns(section, columns, units)
    if section.drawn_as == "heatmap":
        figure = _heatmap(section, data)
    elif section.drawn_as == "lines":
        figure = _lines(section, data)
    else:
        figure = _scatter(section, data)
    if section.title:
        figure.suptitle(section.title, x=0.01, ha="left")
    return figure


# ---------------------------------------------------------------- heatmap
def _heatmap(section: Section, data: SweepColumns) -> Picture:
    x, y = data.numbers(section.x), data.numbers(section.y[0])
    across, i = np.unique(x, return_inverse=True)
    up, j = np.unique(y, return_inverse=True)
    if len(x) != len(across) * len(up) or len({*zip(i.tolist(), j.tolist(), strict=True)}) != len(x):
        raise InputError(
            f"[figure] kind: a heatmap needs each {section.x} with each {section.y[0]} once, as of [grid]; "
            "take a scatter"
        )
    shown = section.colour or ["impulse_Ns"]
    figure = Picture(PAGE, 2.9 if len(shown) < 3 else 2.4)
    panels = figure.subplots(1, len(shown), sharex=True, sharey=True, squeeze=False)[0]
    grey = [f"no result: {data.note()}"] if data.reasons else []
    for axes, name in zip(panels, shown, strict=True):
        table = np.full((len(up), len(across)), np.nan)
        table[j, i] = data.results(name)
        table[~np.isfinite(table)] = np.nan
        axes.set_facecolor(NO_RESULT)
        log = "colour" in section.log and bool((table > 0).any())  # else all have linear colours
        if log and (table <= 0).any():
            grey.append(f"{data.label(name).partition(' [')[0]} of 0 or less, which has no logarithm")
        mesh = axes.pcolormesh(
            _edges(across, "x" in section.log), _edges(up, "y" in section.log),
            np.ma.masked_invalid(table), cmap=SCALE, rasterized=True,
            norm=LogNorm() if log else None,
        )  # fmt: skip
        axes.grid(visible=False)
        bar = figure.colorbar(mesh, ax=axes, format=_PLAIN)
        bar.outline.set_visible(False)
        axes.set_title(data.label(name), loc="left")
        axes.set_xlabel(data.label(section.x))
        for dashes, (column, level) in zip(DASHES, section.contour.items(), strict=False):
            _contour(axes, across, up, (i, j), data.results(column), level, dashes)
        _scales(axes, section)
    panels[0].set_ylabel(data.label(section.y[0]))
    handles: list[Any] = []
    if grey:
        handles.append(Patch(facecolor=NO_RESULT, label="; ".join(grey)))
    for dashes, (column, level) in zip(DASHES, section.contour.items(), strict=False):
        what, _, unit = data.label(column).partition(" [")
        label = f"{what} {level:g} {unit.rstrip(']')}".rstrip()
        handles.append(Line2D([], [], color=BLACK, linestyle=dashes, linewidth=1.4, label=label))
    if handles:
        figure.legend(handles=handles, loc="outside lower left", ncols=min(len(handles), 2))
    return figure


def _edges(values: Array, log: bool) -> Array:
    """Edges (k + 1,) of cells around increasing values (k,), half-way between them on the axis."""
    log = log and values[0] > 0
    x = np.log(values) if log else values
    # a single value has a cell too
    step = np.diff(x) if len(x) > 1 else np.array([1.0 if log else abs(x[0]) or 1.0])
    edges = np.concatenate([x - step[[0, *range(len(x) - 1)]] / 2, [x[-1] + step[-1] / 2]])
    return np.exp(edges) if log else edges


def _contour(
    axes: Any, x: Array, y: Array, at: tuple[Any, Any], values: Array, level: float, dashes: str
) -> None:
    table = np.full((len(y), len(x)), np.nan)
    table[at[1], at[0]] = values
    known = table[np.isfinite(table)]
    if min(table.shape) < 2 or not known.min(initial=np.inf) < level < known.max(initial=-np.inf):
        return
    masked = np.ma.masked_invalid(table)
    for colour, width, style in (("white", 3.2, "-"), (BLACK, 1.4, dashes)):
        axes.contour(x, y, masked, [level], colors=colour, linewidths=width, linestyles=style)


# ---------------------------------------------------------------- lines
def _lines(section: Section, data: SweepColumns) -> Picture:
    x = data.numbers(section.x)
    groups, names = combined(section.colour, data)
    panel, titles = combined([section.panel] if section.panel else [], data)
    figure = Picture(PAGE, 0.7 + (1.6 if len(section.y) > 1 else 2.2) * len(section.y))
    grid = figure.subplots(len(section.y), len(titles), sharex=True, sharey="row", squeeze=False)
    scale = _shades(section, data, groups, names)
    legend: dict[str, Any] = {}  # lines by their labels
    for name, row in zip(section.y, grid, strict=True):
        values, label = data.results(name), data.label(name)
        if section.against:
            values, label = errors_against(section, data, values), name_of_error(section, data, name)
        for k, axes in enumerate(row):
            for g, series in enumerate(names):
                chosen = np.flatnonzero((panel == k) & (groups == g))
                order = chosen[np.argsort(x[chosen], kind="stable")]
                if not np.isfinite(values[order]).any():
                    continue
                mark = MARKS[g % len(MARKS)] if len(order) <= MAX_MARKED else None
                (line,) = axes.plot(x[order], values[order], color=scale[g], marker=mark, markersize=4)
                legend[section.labels.get(series, series)] = line
            _scales(axes, section)
        row[0].set_ylabel(label)
    for k, title in enumerate(titles):
        grid[0, k].set_title(title, loc="left")
        grid[-1, k].set_xlabel(data.label(section.x))
    if len(legend) > 1:
        above = data.label(section.colour[0]) if len(section.colour) == 1 else None
        shown = list(legend.items())
        if _shaded(section, data) and len(shown) > MAX_LISTED:
            shown = [shown[round(k)] for k in np.linspace(0, len(shown) - 1, MAX_LISTED)]
        _legend(figure, [line for _, line in shown], [name for name, _ in shown], above)
    return figure


def _legend(figure: Picture, handles: Sequence[Any], labels: Sequence[str], title: str | None) -> None:
    """Legend below the panels, in as many rows as its labels need."""
    widths = [len(label) + HANDLE_WIDTH for label in labels]
    room = LEGEND_WIDTH * figure.get_figwidth() / PAGE
    columns = len(labels) if sum(widths) <= room else max(int(room / max(widths)), 1)
    figure.legend(handles, labels, loc="outside lower left", title=title, alignment="left", ncols=columns)


def _shaded(section: Section, data: SweepColumns) -> bool:
    """True if lines have the shades of one number."""
    return len(section.colour) == 1 and data.is_numeric(section.colour[0])


def _shades(section: Section, data: SweepColumns, groups: Index, names: Sequence[str]) -> list[Any]:
    """Colours of the groups: shades of one scale for numbers, else distinct ones; models have their own."""
    if MODEL in section.colour:
        again = data.numbers(FREEZES) if FREEZES in section.colour else np.zeros(len(groups))
        first = [int(np.argmax(groups == g)) for g in range(len(names))]
        return [model_colour(data.values(MODEL)[k], again[k]) for k in first]
    return _colours(len(names), 2 if _shaded(section, data) else len(COLOURS))


def _colours(count: int, most: int = len(COLOURS)) -> list[Any]:
    """Distinct colours; shades of one scale, if they are more than `most`."""
    return [colormaps[SCALE](0.9 * k / (count - 1)) if count > most else COLOURS[k] for k in range(count)]


# ---------------------------------------------------------------- scatter
def _scatter(section: Section, data: SweepColumns) -> Picture:
    x, y = data.results(section.x), data.results(section.y[0])
    panel, titles = combined([section.panel] if section.panel else [], data)
    figure = Picture(PAGE if len(titles) > 1 else 0.75 * PAGE, 3.4)
    grid = figure.subplots(1, len(titles), sharex=True, sharey=True, squeeze=False)[0]
    shown = np.isfinite(x) & np.isfinite(y)
    drawn = np.flatnonzero(shown)
    if len(drawn) > MAX_POINTS:
        drawn = np.random.default_rng(0).permutation(drawn)[:MAX_POINTS]
    size = 22.0 if len(drawn) < 500 else 9.0 if len(drawn) < 5000 else 3.0
    colour = section.colour[0] if section.colour else None
    numeric = colour is not None and data.is_numeric(colour)
    norm: Any = None
    if numeric and colour is not None:
        scale, least = (LogNorm, 0.0) if "colour" in section.log else (Normalize, -np.inf)
        levels = data.numbers(colour)[drawn]
        drawn, levels = drawn[levels > least], levels[levels > least]  # others have no colour
        norm = scale(levels.min(), levels.max()) if len(levels) else scale(0.1, 1.0)
    groups, names = combined(section.colour[:1] if not numeric else [], data)
    marks: Any = None
    paints = _colours(len(names))
    for k, (axes, title) in enumerate(zip(grid, titles, strict=True)):
        own = drawn[panel[drawn] == k]
        for g, series in enumerate(names):
            some = own[groups[own] == g]
            paint: dict[str, Any] = {"color": paints[g], "label": series}
            if numeric and colour is not None:
                paint = {"c": data.numbers(colour)[some], "cmap": SCALE, "norm": norm}
            marks = axes.scatter(x[some], y[some], s=size, edgecolors="none", rasterized=True, **paint)
        axes.set_title(title, loc="left")
        axes.set_xlabel(data.label(section.x))
        _scales(axes, section)
    grid[0].set_ylabel(data.label(section.y[0]))
    if numeric and colour is not None:
        bar = figure.colorbar(marks, ax=grid.tolist(), label=data.label(colour))
        bar.outline.set_visible(False)
    elif len(names) > 1 and colour is not None:
        handles, labels = grid[0].get_legend_handles_labels()
        _legend(figure, handles, labels, data.label(colour))
    if shown.sum() > len(drawn):
        figure.supxlabel(f"{len(drawn):,} of {shown.sum():,} rows", fontsize=7, x=0.01, ha="left")
    return figure


def _scales(axes: Any, section: Section) -> None:
    for name, axis in (("x", axes.xaxis), ("y", axes.yaxis)):
        if name not in section.log:
            continue
        set_scale = axes.set_xscale if name == "x" else axes.set_yscale
        set_scale("log")
        axis.set_major_formatter(_PLAIN)


def _number(x: float) -> str:
    """Number as text; large and small powers of ten as such."""
    power = round(np.log10(abs(x))) if x else 0
    if abs(power) >= 4 and np.isclose(abs(x), 10.0**power, rtol=1e-9):
        return f"${'-' if x < 0 else ''}10^{{{power}}}$"
    return f"{x:g}"
