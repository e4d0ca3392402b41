"""Charts of a report: descriptions, and the arrays to which they refer."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.files.output import Record, replay_name
from impactopt.problem.problem import ImpactProblem
from impactopt.report.histories import (
    BUCKETS,
    at_contact,
    footprints,
    ground_wrenches,
    planned_torque,
    soles_standing,
    thinned,
    zmp_margins,
)
from impactopt.report.tracks import planned_hand_speed
from impactopt.simulation.result import centre_of_pressure

__all__ = ["charts_of"]

Array = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]
NEAR = (0.01, 0.03)  # [s] before and after contact, shown of the force at first
# label, prefix in a record, style; the styles are those of style.css
SOURCES = (
    ("planned", "reference", "planned"),
    ("simulated", "simulated", "simulated"),
    ("free soles", "replayed", "free"),
)
OTHERS = ("one", "two")  # styles of series that are no motions


def charts_of(record: Record, problem: ImpactProblem | None = None) -> tuple[list[dict[str, Any]], Arrays]:
    """Descriptions in the order of the page, and arrays by name.

    problem : for the planned speed of the hand; None: without it.
    """
    arrays: Arrays = {}
    charts: list[dict[str, Any] | None] = []
    if record.completed:
        free = replay_name(record.summary)
        names = [(free if key == "replayed" else name, key, style) for name, key, style in SOURCES]
        present = [s for s in names if f"{s[1]}_time" in record.arrays]
        charts += [
            _force(record, arrays, present),
            _speed(record, arrays, present, problem),
            _zmp_margin(record, arrays, present),
            _stances(record, arrays),
            _zmp_path(record, arrays, present),
            _torque_ratio(record, arrays),
            _joint(record, arrays, "torque", "torque", "torque [N m]"),
            _joint(record, arrays, "angle", "angle", "angle [rad]"),
            *_soles(record, arrays),
        ]
    charts += _convergence(record, arrays)
    return [chart for chart in charts if chart is not None], arrays


def _bands(record: Record) -> list[list[float]]:
    """Time span of the planned contact, grey in every chart."""
    return [[float(record.arrays[f"reference_contact_{which}"]) for which in ("start", "end")]]


def _chart(title: str, unit: str, series: list[dict[str, Any]], **rest: Any) -> dict[str, Any]:
    return {"kind": "lines", "title": title, "x": "time [s]", "y": unit, "series": series, **rest}


def _series(
    record: Record, arrays: Arrays, name: str, label: str, style: str, time: Array, values: Array
) -> dict[str, Any]:
    x, y = thinned(time, values, whole=_close_up(record))
    arrays |= {f"{name}_x": x, f"{name}_y": y}
    return {"label": label, "style": style, "x": f"{name}_x", "y": f"{name}_y"}


def _close_up(record: Record) -> list[float]:
    """Time span [s] of contact and its neighbourhood."""
    start, end = _bands(record)[0]
    return [max(0.0, start - NEAR[0]), end + NEAR[1]]


def _force(record: Record, arrays: Arrays, present: list[Any]) -> dict[str, Any]:
    a, series = record.arrays, []
    for label, prefix, style in present:
        time, force = (a[f"{prefix}_time"], a.get(f"{prefix}_force"))
        if force is None:
            time, force = at_contact(record, a["collision_force"], 0.0)
        series.append(_series(record, arrays, f"force_{style}", label, style, time, force))
    view = _close_up(record)
    return _chart("Force on the target", "force [N]", series, bands=_bands(record), view=view, include=[0.0])


def _speed(
    record: Record, arrays: Arrays, present: list[Any], problem: ImpactProblem | None
) -> dict[str, Any]:
    a, hands = record.arrays, {p: f"{p}_hand_speed" for _, p, _ in present}
    known = {prefix: a[name] for prefix, name in hands.items() if name in a}
    if problem is not None:
        known["reference"] = planned_hand_speed(record, problem)
    series = [
        _series(record, arrays, f"speed_{style}", f"hand, {label}", style, a[f"{prefix}_time"], known[prefix])
        for label, prefix, style in present
        if prefix in known
    ]
    time, speed = at_contact(record, a["collision_target_speed"], np.nan)
    series.append(_series(record, arrays, "speed_target", "target, planned", OTHERS[0], time, speed))
    start, end = _bands(record)[0]
    view = [max(0.0, start - 0.2), end + 0.2]
    return _chart(
        "Speed of hand and target along the normal", "speed [m/s]", series, bands=_bands(record), view=view
    )


def _zmp_margin(record: Record, arrays: Arrays, present: list[Any]) -> dict[str, Any] | None:
    if not len(record.arrays["polygon"]):
        return None
    series = []
    for label, prefix, style in present:
        time, wrench = ground_wrenches(record, prefix)
        inside = 1e3 * zmp_margins(record, time, wrench)
        series.append(_series(record, arrays, f"margin_{style}", label, style, time, inside))
    note = "Distance of the zero-moment point from the support polygon's nearest edge; below 0 it is outside."
    limits = [{"y": 0.0, "text": "edge"}]
    return _chart(
        "ZMP margin",
        "margin [mm]",
        series,
        bands=_bands(record),
        include=[0.0],
        limits=limits,
        note=note,
        height=300,
    )


def _stances(record: Record, arrays: Arrays) -> dict[str, Any] | None:
    """Strip of the soles that are planned to stand; None for a plan with one stance."""
    time = record.arrays["reference_time"]
    standing, series = soles_standing(record, time), []
    for k, (name, on) in enumerate(standing.items()):
        at = np.where(on, float(k), np.nan)
        style = OTHERS[k % len(OTHERS)]
        series.append(_series(record, arrays, f"stands_{k}", name, style, time, at))
    if not series:
        return None
    around = [-1.0, float(len(series))]
    more: dict[str, Any] = {"word": "stands", "include": around, "height": 120}  # no axis of values
    return _chart("Soles on the ground", "", series, bands=_bands(record), **more)


def _zmp_path(record: Record, arrays: Arrays, present: list[Any]) -> dict[str, Any] | None:
    polygon = record.arrays["polygon"]
    if not len(polygon):
        return None
    series = []
    for label, prefix, style in present:
        time, wrench = ground_wrenches(record, prefix)
        t, x, y = thinned(time, *centre_of_pressure(wrench).T, whole=_close_up(record))
        points, name = np.column_stack([x, y]), f"zmp_{style}"
        arrays |= {name: points, f"{name}_time": t}
        # the value shown for a point is that of the margin's chart
        beside = {"x": f"margin_{style}_x", "y": f"margin_{style}_y"}
        series.append({"label": label, "style": style, "xy": name, "time": f"{name}_time", **beside})
    soles = footprints(record)
    arrays |= {f"ground_{name}": corners for name, corners in soles.items()}
    arrays["ground_polygon"] = polygon
    return {
        "kind": "ground",
        "title": "ZMP in the support polygon",
        "x": "-y, to the right [m]",
        "y": "x, forward [m]",
        "series": series,
        "polygon": "ground_polygon",
        "soles": [f"ground_{name}" for name in soles],
        "height": 300,
        "note": "From above; drag to move. The dots show the ZMP at the time of the animation.",
    }


def _torque(record: Record) -> list[tuple[str, str, Array, Array]]:
    """Label, style, time, torque (k, n) [N m] of the plan and of the simulation's demand."""
    a = record.arrays
    out = [("planned", "planned", *planned_torque(record))]
    if record.simulated:
        out.append(("simulated", "simulated", a["simulated_time"], a["simulated_demand"]))
    return out


def _torque_ratio(record: Record, arrays: Arrays) -> dict[str, Any]:
    series = []
    for label, style, time, torque in _torque(record):
        ratio = np.abs(torque / record.arrays["torque_limit"]).max(axis=1)
        series.append(_series(record, arrays, f"ratio_{style}", label, style, time, ratio))
    limits = [{"y": 1.0, "text": "limit"}]
    return _chart(
        "Torque demand over limit",
        "torque / limit",
        series,
        bands=_bands(record),
        include=[0.0, 1.0],
        limits=limits,
        note="Of the joint closest to its limit.",
    )


def _joint(record: Record, arrays: Arrays, which: str, title: str, unit: str) -> dict[str, Any]:
    """History of one joint, chosen by the reader; at first the one whose torque is closest to its limit."""
    a, series = record.arrays, []
    limit = a["torque_limit"]
    for label, style, time, torque in _torque(record):
        values = torque
        if which == "angle":
            prefix = "reference" if style == "planned" else "simulated"
            time, values = a[f"{prefix}_time"], a[f"{prefix}_angle"]
        chosen = np.unique(np.linspace(0, len(time) - 1, 2 * BUCKETS).astype(int))
        near = np.abs(time - float(a["reference_contact_start"])) < 0.1
        chosen = np.union1d(chosen, np.flatnonzero(near)[:: max(1, int(near.sum()) // BUCKETS)])
        arrays |= {f"{which}_{style}_x": time[chosen], f"{which}_{style}": values[chosen]}
        series.append({"label": label, "style": style, "x": f"{which}_{style}_x", "y": f"{which}_{style}"})
    worst = np.abs(_torque(record)[0][3] / limit).max(axis=0).argmax()
    lines = (
        [{"values": limit, "text": "limit"}, {"values": -limit, "text": "limit"}] if which == "torque" else []
    )
    return _chart(
        f"One joint's {title}",
        unit,
        series,
        kind="joint",
        bands=_bands(record),
        joints=[str(name) for name in a["joints"]],
        joint=int(worst),
        lines=lines,
    )


def _soles(record: Record, arrays: Arrays) -> list[dict[str, Any]]:
    """Charts of each sole in the most faithful replay."""
    prefix = "replayed" if record.replayed else "simulated"
    a = record.arrays
    names = a.get(f"{prefix}_soles", [n.removeprefix("sole_") for n in a if n.startswith("sole_")])
    if f"{prefix}_sole_ground" not in a or not len(names):
        return []
    how, out = "on free soles" if record.replayed else "on fixed soles", []
    time = a[f"{prefix}_time"]
    standing, always = soles_standing(record, time), np.ones(len(time), dtype=bool)
    away = np.column_stack([~standing.get(str(name), always) for name in names])
    for what, unit, title, values in (
        (
            "pressed",
            "margin [mm]",
            "Margin of each sole's centre of pressure",
            np.where(away, np.nan, 1e3 * a[f"{prefix}_cop_margin"]),
        ),
        ("load", "force [N]", "Normal force on each sole", a[f"{prefix}_sole_ground"][:, :, 2]),
    ):
        series = [
            _series(
                record,
                arrays,
                f"{what}_{k}",
                str(name),
                OTHERS[k % len(OTHERS)],
                a[f"{prefix}_time"],
                values[:, k],
            )
            for k, name in enumerate(names)
        ]
        note = {"note": "Distance to the sole's nearest edge; at 0 it tips."} if what == "pressed" else {}
        bands = _bands(record)
        out.append(_chart(f"{title}, simulated {how}", unit, series, bands=bands, include=[0.0], **note))
    return out


def _convergence(record: Record, arrays: Arrays) -> list[dict[str, Any]]:
    """Chart of violation and optimality over the solver's iterations."""
    a = record.arrays
    if "history_iteration" not in a:
        return []
    iteration = a["history_iteration"].astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        digits = {name: np.log10(a[f"history_{name}"]) for name in ("max_violation", "kkt")}
    series = []
    for name, label, style in zip(("max_violation", "kkt"), ("violation", "optimality"), OTHERS, strict=True):
        y = np.where(np.isfinite(digits[name]), digits[name], np.nan)
        if np.isfinite(y).any():
            arrays |= {"history_x": iteration, f"history_{name}": y}
            series.append({"label": label, "style": style, "x": "history_x", "y": f"history_{name}"})
    if not series:
        return []
    chart = _chart("Convergence of the solver", "largest error", series, log=True, timed=False)
    return [{**chart, "x": "iteration"}]
