"""Where and how the striking point meets the target: rows at contact."""

from __future__ import annotations

import numpy as np

from impactopt.problem.terms import HitCone, HitRegion
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact import ContactState
from impactopt.transcription.layout import Array
from impactopt.transcription.rows import Measure, Place, millimetres


def rotation_rows(normal: Array) -> Array:
    """(3, 3) rows: the normal and two tangents."""
    _, _, vt = np.linalg.svd(normal.reshape(1, 3))
    rows = np.vstack([normal, vt[1:]])
    return rows


def add_touch_rows(b: Builder, state: ContactState) -> None:
    """Hit point, approach speed and incidence, but for what a term of the problem takes the place of; of a
    second striker too.
    """
    _add_rows(b, state, "contact", b.problem.point, "")
    if b.problem.second is not None:
        _add_rows(b, state, "second_contact", b.problem.second.point, f"{b.problem.second.striker} ")


def _add_rows(b: Builder, state: ContactState, block: str, point: Array, named: str) -> None:
    """``named`` : before the components' names."""
    p, incidence = b.problem, b.limits.incidence
    at = b.add_block(block, [[state.y, state.y1, state.T]], rotation_rows(p.normal).ravel())
    if p.extra(HitRegion) is None:
        b.rows.add(
            term="hit point",
            place=Place("contact", ""),
            components=[f"{named}{axis}" for axis in "xyz"],
            outputs=at + np.arange(3),
            lower=point,
            upper=point,
            measure=millimetres("away"),
        )
    b.rows.add(
        term="approach speed",
        place="contact",
        components=[f"{named}normal"],
        outputs=np.array([at + 3]),
        lower=0.05 + float(p.target.speed_before()),
        measure=Measure("m/s", 1.0, "too slow"),
    )
    if p.extra(HitCone) is None:
        b.rows.add(
            term=incidence.name,
            place="contact",
            components=[f"{named}tangent 1", f"{named}tangent 2"],
            outputs=at + np.array([4, 5]),
            lower=-incidence.speed,
            upper=incidence.speed,
            measure=Measure("m/s", 1.0, "too fast across the normal"),
            whole="",
        )
