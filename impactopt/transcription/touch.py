"""Contact conditions: constraints on position and direction of the striking point as it meets the target."""

from __future__ import annotations

import numpy as np

from impactopt.kinematics.directions import across
from impactopt.problem.terms import HitCone, HitRegion
from impactopt.transcription.builder import Builder
from impactopt.transcription.contact import ContactState
from impactopt.transcription.layout import Array
from impactopt.transcription.rows import Measure, Place, millimetres


def rotation_rows(normal: Array) -> Array:
    """(3, 3) rows: the normal and two tangents."""
    return np.vstack([normal, across(normal)])


def _slowest(b: Builder) -> float:
    """Approach speed [m/s]."""
    return 0.05 + float(b.problem.target.speed_before())


def add_touch_rows(b: Builder, state: ContactState) -> None:
    """Hit point, approach speed and incidence, but for what a term of the problem takes the place of; of a
    second striker too.
    """
    for k, block in enumerate(["contact", "second_contact"][: len(b.problem.strikers)]):
        _add_rows(b, state, block, k)


def _add_rows(b: Builder, state: ContactState, block: str, number: int) -> None:
    p, incidence = b.problem, b.limits.incidence
    striker, point = p.contacts[number]
    named = f"{striker} " if number else ""
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
        place = len(b.rows.lower) - 1

        def follow(b: Builder) -> None:
            at = b.problem.contacts[number][1]
            b.rows.bound(place, at, at)

        b.follow(follow)
    b.rows.add(
        term="approach speed",
        place="contact",
        components=[f"{named}normal"],
        outputs=np.array([at + 3]),
        lower=_slowest(b),
        measure=Measure("m/s", 1.0, "too slow"),
    )
    approach = len(b.rows.lower) - 1
    b.follow(lambda b: b.rows.bound(approach, _slowest(b), np.inf))
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
