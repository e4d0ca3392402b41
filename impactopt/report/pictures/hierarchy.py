"""Contact force by every model of the hierarchy (the paper's Fig. 7)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from scipy.integrate import cumulative_trapezoid

from impactopt.arrays import Array
from impactopt.collision import Collision
from impactopt.errors import InputError
from impactopt.report.pictures.style import MODELS, PAGE, Picture, styled

# from the coarsest model to the finest: virtual mass, the paper's SDC, ours, and ours frozen again in shades
# of one colour
STYLES: tuple[dict[str, Any], ...] = (
    {"color": MODELS["virtual-mass"], "linestyle": ":", "linewidth": 1.8},
    {"color": MODELS["sdc-paper"], "linestyle": "--"},
    {"color": MODELS["sdc"], "linewidth": 1.4},
    {"color": "#003D63", "linestyle": "-.", "linewidth": 1.2},
    {"color": MODELS["freezes"], "linewidth": 1.2},
    {"color": "#4DA3D4", "linestyle": (0, (4, 1)), "linewidth": 1.2},
    {"color": "#8CC4E6", "linestyle": (0, (1, 1)), "linewidth": 1.4},
)
MIN_ERROR = 1e-4  # of the impulse: lower end of the scale
REFERENCE: dict[str, Any] = {"color": MODELS["full"], "linewidth": 3.2, "alpha": 0.35}


@styled
def hierarchy(blows: Mapping[str, Mapping[str, Collision]], *, reference: str = "full dynamics") -> Picture:
    """Force histories on the left, and errors of the impulse so far on the right; one row for each impact.

    blows : of each impact, by title, the :class:`impactopt.collision.Collision` of each model, by name, the
        coarsest first. The legends show the errors of their impulses.
    reference : name of the model with which the others are compared.

    Raises
    ------
    InputError : no impact; an impact without the reference; more models than styles.
    """
    names = list(dict.fromkeys(name for models in blows.values() for name in models if name != reference))
    if not blows or any(reference not in models for models in blows.values()):
        raise InputError(f"every impact needs the model {reference!r}, with which the others are compared")
    if len(names) > len(STYLES):
        raise InputError(f"at most {len(STYLES)} models besides the reference can be distinguished: {names}")
    styles = dict(zip(names, STYLES, strict=False))
    figure = Picture(PAGE, 2.0 * len(blows) + 0.9)
    grid = figure.subplots(len(blows), 2, sharex=True, squeeze=False, width_ratios=[1.15, 1.0])
    last = max(hit.duration for models in blows.values() for hit in models.values())
    for (left, right), (heading, models) in zip(grid, blows.items(), strict=True):
        true = models[reference]
        left.plot(*_history(true, last), **REFERENCE)
        for name, style in styles.items():
            if name in models:
                left.plot(*_history(models[name], last), **style)
                right.plot(*_difference(models[name], true), **style)
                right.plot([], [], label=_error(models[name], true), **style)
        left.set_title(f"{heading}: {true.impulse:.2f} N s", loc="left")
        left.set(ylabel="force [N]", xlim=(-30 * last, 1060 * last))
        left.set_ylim(bottom=0.0)
        right.set(yscale="log", ylabel="impulse off by [N s]", ylim=(MIN_ERROR * true.impulse, true.impulse))
        right.legend(title="in the end", loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.6)
    for axes in grid[-1]:
        axes.set_xlabel("time since contact [ms]")
    handles = [Line2D([], [], label=reference, **REFERENCE)]
    handles += [Line2D([], [], label=name, **style) for name, style in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _history(hit: Collision, last: float) -> tuple[Array, Array]:
    """Time [ms] and force [N], zero before and after contact."""
    time = 1e3 * np.concatenate([[-0.03 * last, 0.0], hit.time, [1.06 * last]])
    return time, np.concatenate([[0.0, 0.0], hit.force, [0.0]])


def _difference(hit: Collision, true: Collision) -> tuple[Array, Array]:
    """Time [ms], and error [N s] of the impulse until then."""
    time = np.union1d(hit.time, true.time)
    ours, theirs = (_delivered(one, time) for one in (hit, true))
    return 1e3 * time, np.abs(ours - theirs)


def _delivered(hit: Collision, time: Array) -> Array:
    """Impulse [N s] until each time, for a piecewise linear force."""
    return cumulative_trapezoid(np.interp(time, hit.time, hit.force, right=0.0), time, initial=0.0)


def _error(hit: Collision, true: Collision) -> str:
    """Error of the impulse as text."""
    error = 100 * (hit.impulse / true.impulse - 1)
    return f"{error:+.2f} %" if abs(error) >= 0.005 else "< 0.01 %"
