"""Fig. 3: complexity ratios over the sampling time, of HRP-2's tree; and times of ours on the stand-in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.costs import HRP2, TOTAL_TIME, cost_aba, cost_full, cost_sdc, iterations
from benchmarks.paper.timing import Times, measure
from benchmarks.report import Report, Say, cell, columns_table
from impactopt.kinematics.operational_space import striking_velocity
from impactopt.robots.presets import standin

if TYPE_CHECKING:
    from impactopt.report.pictures.style import Picture

STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5, 1e-6)  # [s]
# what the paper's text says of fig. 3: C_r1 "about 0.016", C_r3 "about 1/4"
PRINTED = {"C_r1": {1e-3: 0.016}, "C_r3": {1e-4: 0.25}}
COLUMNS = (
    ("t_s s", "t_s_s", "g"),
    ("C_r1", "C_r1", 4),
    ("paper", "C_r1_paper", 3),
    ("measured", "C_r1_measured", 4),
    ("C_r3", "C_r3", 4),
    ("paper", "C_r3_paper", 2),
    ("measured", "C_r3_measured", 4),
)


def ratios(step: float) -> dict[str, float]:
    """C_r1 and C_r3 of HRP-2 for a sampling time [s] (21, 23)."""
    count = iterations(step)
    sdc = cost_sdc(HRP2, count)
    return {"C_r1": sdc / cost_full(HRP2, count), "C_r3": sdc / cost_aba(HRP2, count)}


def run(say: Say) -> Report:
    """The formulas, and the measured ratios of the stand-in's computations."""
    robot = standin()
    q = robot.posture("half_sitting")
    v = striking_velocity(robot, q, "right_hand", [1.0, 0.0, 0.0], 1.0)
    say("measuring on the stand-in (compiles the first time)")
    times = measure(robot, q, v, "right_hand")
    rows = [row(step, times) for step in STEPS]
    numbers: dict[str, Any] = {
        "rows": rows,
        "n": HRP2.n,
        "t_total_s": TOTAL_TIME,
        "measured_on": "standin",
        "times": times.microseconds(),
    }
    title = f"Fig. 3: n = 28, 0.1 s. Measured on the stand-in, {in_words(times)}"
    table = columns_table(title, COLUMNS, rows)
    return Report(name="fig3", numbers=numbers, tables=(table,), figures={"fig3": lambda: draw(rows)})


def row(step: float, times: Times) -> dict[str, Any]:
    """One sampling time; the paper's values where its text has them."""
    count, found = iterations(step), ratios(step)
    out: dict[str, Any] = {"t_s_s": step, "T_i": count}
    measured = {"C_r1": times.ratio_1(count), "C_r3": times.ratio_3(count)}
    for name, value in found.items():
        printed = PRINTED[name].get(step)
        out |= {
            name: value,
            f"{name}_paper": printed,
            f"{name}_error": None if printed is None else value - printed,
            f"{name}_measured": measured[name],
        }
    return out


def in_words(times: Times) -> str:
    """The times in microseconds."""
    us = times.microseconds()
    return (
        f"us: dense {cell(us['full_us'], 1)}, freeze {cell(us['freeze_us'], 1)}, stage "
        f"{cell(us['stage_us'], 2)}, ABA {cell(us['aba_us'], 1)}"
    )


def draw(rows: list[dict[str, Any]]) -> Picture:
    """Formulas as lines, measured ratios as marks."""
    from impactopt.report.pictures.style import styled

    return styled(_drawn)(rows)


def _drawn(rows: list[dict[str, Any]]) -> Picture:
    from impactopt.report.pictures.style import BLUE, PAGE, VERMILION, Picture

    figure = Picture(PAGE, 3.6)
    steps = np.array([r["t_s_s"] for r in rows])
    fine = np.geomspace(steps.min(), steps.max(), 200)
    names = {"C_r1": "$C_{r1} = C_2 / C_1$", "C_r3": "$C_{r3} = C_2 / C_3$"}
    against = {"C_r1": "against dense full dynamics", "C_r3": "against articulated bodies"}
    for axes, (name, label) in zip(figure.subplots(1, 2), names.items(), strict=True):
        line = [ratios(float(step))[name] for step in fine]
        axes.loglog(fine, line, color=BLUE, label="operations, n = 28 (paper's formula)")
        axes.loglog(
            steps,
            [r[f"{name}_measured"] for r in rows],
            "o",
            color=VERMILION,
            label="time, ours on the stand-in",
        )
        axes.set(xlabel="sampling time [s]", ylabel=label)
        axes.set_title(against[name])
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2)
    figure.suptitle("Cost of the SDC over 0.1 s")
    return figure
