"""Charts of a report: descriptions, and the arrays to which they refer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.arrays import Array
from impactopt.files.record import Record, replay_name
from impactopt.problem.problem import ImpactProblem
from impactopt.report.histories import (
    BUCKETS,
    at_contact,
    contact_force,
    footprints,
    ground_wrenches,
    planned_torque,
    soles_standing,
    thinned,
    zmp_margins,
)
from impactopt.report.tracks import planned_hand_speed
from impactopt.simulation.result import centre_of_pressure

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

    problem : for the planned speed of the striking point; None: without it.
    """
    arrays: Arrays = {}
    charts = list(_Charts(record, problem, arrays).all()) if record.completed else []
    return [*charts, *_convergence(record, arrays)], arrays


def chart(title: str, unit: str, series: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    """Description of a chart over time, or over what `more` has as x."""
    return {"kind": "lines", "title": title, "x": "time [s]", "y": unit, "series": series, **more}


def series_of(arrays: Arrays, name: str, label: str, style: str, x: Array, y: Array) -> dict[str, Any]:
    """Description of a line in a chart, whose numbers are added to `arrays`."""
    arrays |= {f"{name}_x": x, f"{name}_y": y}
    return {"label": label, "style": style, "x": f"{name}_x", "y": f"{name}_y"}


class _Charts:
    """Charts of a record's motions."""

    def __init__(self, record: Record, problem: ImpactProblem | None, arrays: Arrays) -> None:
        self.record, self.problem, self.arrays = record, problem, arrays
        a, free = record.arrays, replay_name(record.summary)
        names = [(free if key == "replayed" else name, key, style) for name, key, style in SOURCES]
        self.present = [source for source in names if f"{source[1]}_time" in a]
        self.start, self.end = (float(a[f"reference_contact_{which}"]) for which in ("start", "end"))
        self.close_up = [max(0.0, self.start - NEAR[0]), self.end + NEAR[1]]
        self.legged = len(a["polygon"]) > 0

    def all(self) -> Iterator[dict[str, Any]]:
        """Charts in the order of the page."""
        yield self._force()
        yield self._speed()
        if self.legged:
            yield self._zmp_margin()
        yield from self._stances()
        if self.legged:
            yield self._zmp_path()
        yield self._torque_ratio()
        slides = self.record.slides
        yield self._joint("torque", "torque or force [N m or N]" if slides else "torque [N m]")
        yield self._joint("angle", "angle or travel [rad or m]" if slides else "angle [rad]")
        yield from self._soles()

    def _chart(self, title: str, unit: str, series: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
        """Chart in which the planned contact is grey."""
        return chart(title, unit, series, bands=[[self.start, self.end]], **more)

    def _series(self, name: str, label: str, style: str, time: Array, values: Array) -> dict[str, Any]:
        return series_of(self.arrays, name, label, style, *thinned(time, values, whole=self.close_up))

    def _force(self) -> dict[str, Any]:
        series = []
        for label, prefix, style in self.present:
            time, force = contact_force(self.record, prefix)
            series.append(self._series(f"force_{style}", label, style, time, force))
        return self._chart("Force on the target", "force [N]", series, view=self.close_up, include=[0.0])

    def _speed(self) -> dict[str, Any]:
        a, series = self.record.arrays, []
        for label, prefix, style in self.present:
            speed = a.get(f"{prefix}_hand_speed")
            if prefix == "reference" and self.problem is not None:
                speed = planned_hand_speed(self.record, self.problem)
            if speed is not None:
                time = a[f"{prefix}_time"]
                series.append(self._series(f"speed_{style}", f"striking point, {label}", style, time, speed))
        time, speed = at_contact(self.record, a["collision_target_speed"], np.nan)
        series.append(self._series("speed_target", "target, planned", OTHERS[0], time, speed))
        view = [max(0.0, self.start - 0.2), self.end + 0.2]
        title = "Speed of striking point and target along the normal"
        return self._chart(title, "speed [m/s]", series, view=view)

    def _zmp_margin(self) -> dict[str, Any]:
        series = []
        for label, prefix, style in self.present:
            time, wrench = ground_wrenches(self.record, prefix)
            inside = 1e3 * zmp_margins(self.record, time, wrench)
            series.append(self._series(f"margin_{style}", label, style, time, inside))
        return self._chart(
            "ZMP margin",
            "margin [mm]",
            series,
            include=[0.0],
            limits=[{"y": 0.0, "text": "edge"}],
            note="Distance of the zero-moment point from the support polygon's nearest edge; below 0 it is "
            "outside.",
            height=300,
        )

    def _stances(self) -> Iterator[dict[str, Any]]:
        """Strip of the soles that are planned to stand; none for a plan with one stance."""
        time, series = self.record.arrays["reference_time"], []
        for k, (name, on) in enumerate(soles_standing(self.record, time).items()):
            at, style = np.where(on, float(k), np.nan), OTHERS[k % len(OTHERS)]
            series.append(self._series(f"stands_{k}", name, style, time, at))
        if series:
            around = [-1.0, float(len(series))]  # no axis of values
            yield self._chart("Soles on the ground", "", series, word="stands", include=around, height=120)

    def _zmp_path(self) -> dict[str, Any]:
        series = []
        for label, prefix, style in self.present:
            time, wrench = ground_wrenches(self.record, prefix)
            t, x, y = thinned(time, *centre_of_pressure(wrench).T, whole=self.close_up)
            name = f"zmp_{style}"
            self.arrays |= {name: np.column_stack([x, y]), f"{name}_time": t}
            # the value shown for a point is that of the margin's chart
            beside = {"x": f"margin_{style}_x", "y": f"margin_{style}_y"}
            series.append({"label": label, "style": style, "xy": name, "time": f"{name}_time", **beside})
        soles = footprints(self.record)
        self.arrays |= {f"ground_{name}": corners for name, corners in soles.items()}
        self.arrays["ground_polygon"] = self.record.arrays["polygon"]
        contact = " The polygon is that at contact." if self.record.summary.get("stances") else ""
        return {
            "kind": "ground",
            "title": "ZMP in the support polygon",
            "x": "-y, to the right [m]",
            "y": "x, forward [m]",
            "series": series,
            "polygon": "ground_polygon",
            "soles": [f"ground_{name}" for name in soles],
            "height": 300,
            "note": f"From above; drag to move. The dots show the ZMP at the time of the animation.{contact}",
        }

    def _torque(self) -> list[tuple[str, Array, Array]]:
        """Label, which is the style, too, time, torque (k, n) [N m] of the plan and of the simulation."""
        a = self.record.arrays
        out = [("planned", *planned_torque(self.record))]
        if self.record.simulated:
            out.append(("simulated", a["simulated_time"], a["simulated_demand"]))
        return out

    def _torque_ratio(self) -> dict[str, Any]:
        series = []
        for label, time, torque in self._torque():
            ratio = np.abs(torque / self.record.arrays["torque_limit"]).max(axis=1)
            series.append(self._series(f"ratio_{label}", label, label, time, ratio))
        return self._chart(
            "Torque demand over limit",
            "torque / limit",
            series,
            include=[0.0, 1.0],
            limits=[{"y": 1.0, "text": "limit"}],
            note="Of the joint closest to its limit.",
        )

    def _joint(self, which: str, unit: str) -> dict[str, Any]:
        """History of one joint, chosen by the reader; at first the one whose torque is closest to its
        limit.
        """
        a, series, torques = self.record.arrays, [], self._torque()
        limit = a["torque_limit"]
        for label, time, values in torques:
            if which == "angle":
                prefix = "reference" if label == "planned" else "simulated"
                time, values = a[f"{prefix}_time"], a[f"{prefix}_angle"]
            chosen = np.unique(np.linspace(0, len(time) - 1, 2 * BUCKETS).astype(int))
            near = np.abs(time - self.start) < 0.1
            chosen = np.union1d(chosen, np.flatnonzero(near)[:: max(1, int(near.sum()) // BUCKETS)])
            name = f"{which}_{label}"
            self.arrays |= {f"{name}_x": time[chosen], name: values[chosen]}
            series.append({"label": label, "style": label, "x": f"{name}_x", "y": name})
        return self._chart(
            f"One joint's {which}",
            unit,
            series,
            kind="joint",
            joints=[str(name) for name in a["joints"]],
            joint=int(np.abs(torques[0][2] / limit).max(axis=0).argmax()),
            lines=[{"values": side * limit, "text": "limit"} for side in (1, -1) if which == "torque"],
        )

    def _soles(self) -> Iterator[dict[str, Any]]:
        """Charts of each sole in the most faithful replay."""
        a, free = self.record.arrays, self.record.replayed
        prefix, how = ("replayed", "on free soles") if free else ("simulated", "on fixed soles")
        names = a.get(f"{prefix}_soles", [n.removeprefix("sole_") for n in a if n.startswith("sole_")])
        if f"{prefix}_sole_ground" not in a or not len(names):
            return
        time = a[f"{prefix}_time"]
        standing, always = soles_standing(self.record, time), np.ones(len(time), dtype=bool)
        on = np.column_stack([standing.get(str(name), always) for name in names])
        margins = np.where(on, 1e3 * a[f"{prefix}_cop_margin"], np.nan)
        note = {"note": "Distance to the sole's nearest edge; at 0 it tips."}
        for what, unit, title, values, more in (
            ("pressed", "margin [mm]", "Margin of each sole's centre of pressure", margins, note),
            ("load", "force [N]", "Normal force on each sole", a[f"{prefix}_sole_ground"][:, :, 2], {}),
        ):
            series = [
                self._series(f"{what}_{k}", str(name), OTHERS[k % len(OTHERS)], time, values[:, k])
                for k, name in enumerate(names)
            ]
            yield self._chart(f"{title}, simulated {how}", unit, series, include=[0.0], **more)


def _convergence(record: Record, arrays: Arrays) -> Iterator[dict[str, Any]]:
    """Chart of violation and optimality over the solver's iterations."""
    a, series = record.arrays, []
    if "history_iteration" not in a:
        return
    arrays["history_x"] = a["history_iteration"].astype(float)
    for name, label, style in zip(("max_violation", "kkt"), ("violation", "optimality"), OTHERS, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            digits = np.log10(a[f"history_{name}"])
        if np.isfinite(digits).any():
            arrays[f"history_{name}"] = np.where(np.isfinite(digits), digits, np.nan)
            series.append({"label": label, "style": style, "x": "history_x", "y": f"history_{name}"})
    if series:
        yield chart(
            "Convergence of the solver", "largest error", series, log=True, timed=False, x="iteration"
        )
