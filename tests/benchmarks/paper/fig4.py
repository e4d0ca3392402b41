"""Fig. 4: complexity ratios over the degrees of freedom; and what ours measure on random trees.

Four limbs of n / 4 joints, sampling time 1e-4 s. Measured sizes end where compiling a function takes longer
than some ten seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.costs import cost_aba, cost_full, cost_sdc, even_tree, iterations
from benchmarks.paper.timing import measure
from benchmarks.report import Report, Say, columns_table
from benchmarks.trees import random_robot, tip_speed

if TYPE_CHECKING:
    from impactopt.report.pictures.style import Picture

SIZES = (*range(8, 101, 4), 97)
STEP = 1e-4  # [s]
LEAST = 8  # the formula of C_3 is next to zero for a single joint
MEASURED = (8, 16, 24, 32, 40, 48)
MOST_DENSE = 36  # joints whose dense code is compiled
PAPER = "under 100 DOF, the complexity ratio is under one"
COLUMNS = (
    ("n", "n", 0),
    ("C_r1", "C_r1", 4),
    ("measured", "C_r1_measured", 4),
    ("C_r3", "C_r3", 4),
    ("measured", "C_r3_measured", 4),
    ("dense", "full_us", 2),
    ("freeze", "freeze_us", 2),
    ("stage", "stage_us", 2),
    ("ABA", "aba_us", 2),
)


def ratios(n: float) -> dict[str, float]:
    """C_r1 and C_r3 of an even tree (21, 23)."""
    tree, count = even_tree(n), iterations(STEP)
    sdc = cost_sdc(tree, count)
    return {"C_r1": sdc / cost_full(tree, count), "C_r3": sdc / cost_aba(tree, count)}


def crossing() -> float:
    """n at which C_r3 = 1."""
    low, high = float(LEAST), 200.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if ratios(middle)["C_r3"] < 1 else (low, middle)
    return high


def run(say: Say, *, measured: Sequence[int] = MEASURED) -> Report:
    """The formulas, and the measured ratios of random trees."""
    times: dict[int, Any] = {}
    for n in measured:
        say(f"measuring a tree of {n} joints (compiles the first time)")
        robot, rng = random_robot(n), np.random.default_rng(1)
        q, v = rng.uniform(-1, 1, size=n), rng.normal(size=n)
        v *= np.sign(tip_speed(robot, q, v))  # towards the target
        times[n] = measure(robot, q, v, "tip", full=n <= MOST_DENSE)
    rows: list[dict[str, Any]] = []
    for n in sorted({*SIZES, *measured}):
        found, one = ratios(n), times.get(n)
        rows.append(
            {
                "n": n,
                **found,
                "C_r1_measured": one and one.ratio_1(iterations(STEP)),
                "C_r3_measured": one and one.ratio_3(iterations(STEP)),
                "times": one and one.microseconds(),
            }
        )
    first = next(n for n in range(LEAST, 1000) if ratios(n)["C_r3"] >= 1)
    numbers: dict[str, Any] = {
        "rows": rows,
        "t_s_s": STEP,
        "C_r3_is_1_at_n": crossing(),
        "C_r3_first_n_not_below_1": first,
        "C_r3_paper": PAPER,
    }
    title = f"Fig. 4: four limbs, 1e-4 s; C_r3 reaches 1 at n = {first}. Times in us"
    table = columns_table(title, COLUMNS, [{**r, **(r["times"] or {})} for r in rows])
    return Report(name="fig4", numbers=numbers, tables=(table,), figures={"fig4": lambda: draw(rows)})


def draw(rows: list[dict[str, Any]]) -> Picture:
    """Formulas as lines, measured ratios as marks."""
    from impactopt.report.pictures.style import styled

    return styled(_drawn)(rows)


def _drawn(rows: list[dict[str, Any]]) -> Picture:
    from impactopt.report.pictures.style import BLACK, BLUE, PAGE, VERMILION, Picture

    figure = Picture(PAGE, 3.6)
    fine = np.arange(8, 121)
    names = {"C_r1": "$C_{r1} = C_2 / C_1$", "C_r3": "$C_{r3} = C_2 / C_3$"}
    against = {"C_r1": "against dense full dynamics", "C_r3": "against articulated bodies"}
    for axes, (name, label) in zip(figure.subplots(1, 2), names.items(), strict=True):
        axes.plot(
            fine, [ratios(int(n))[name] for n in fine], color=BLUE, label="operations (paper's formula)"
        )
        marks = [(r["n"], r[f"{name}_measured"]) for r in rows if r[f"{name}_measured"] is not None]
        if marks:
            axes.plot(*zip(*marks, strict=True), "o", color=VERMILION, label="time, ours on random trees")
        if name == "C_r3":
            axes.axhline(1.0, color=BLACK, linewidth=0.8, linestyle=":")
            axes.set_ylim(bottom=0.0)
        else:
            axes.set_yscale("log")
        axes.set(xlabel="degrees of freedom", ylabel=label)
        axes.set_title(against[name])
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2)
    figure.suptitle("Cost of the SDC over 0.1 s, sampling time 1e-4 s")
    return figure
