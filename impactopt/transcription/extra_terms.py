"""Rows of the terms that only some problems have."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from impactopt.bodies.shapes import face_axes
from impactopt.problem.extra_terms import (
    Gaze,
    HandOrientation,
    HitCone,
    HitRegion,
    TorqueRate,
)
from impactopt.problem.terms import Term, kind_of
from impactopt.transcription.layout import Affine, Group
from impactopt.transcription.objective import start_torque
from impactopt.transcription.rows import Measure, Place, degrees, millimetres

if TYPE_CHECKING:
    from impactopt.transcription.at_contact import ContactProgram
    from impactopt.transcription.transcription import Transcription

CONTACT = "contact"


def add_extra_terms(t: ContactProgram, terms: tuple[Term, ...]) -> None:
    """Blocks and rows of each extra one among these terms."""
    for term in terms:
        if type(term).add_rows is not Term.add_rows:  # a user's own
            term.add_rows(t)
        elif (add := _ADD.get(kind_of(term, Term))) is not None:
            add(t, term)


def _torque_rate(t: Transcription, term: TorqueRate) -> None:
    """The torques are variables, so these rows are linear, of a duration that is one too."""
    names = t.robot.joint_names
    limit = [
        term.limit.get(name, np.inf) if isinstance(term.limit, Mapping) else term.limit for name in names
    ]
    joints = np.flatnonzero(np.isfinite(limit))
    rate = np.array(limit)[joints] / t.robot.torque_limit[joints]
    labels = [names[j] for j in joints]
    swing, follow = len(t.swing_nodes), len(t.follow_nodes)
    start = Affine.constant(start_torque(t))
    phases = [(t.swing_place, np.append(0.0, t.swing_nodes), [start, *t.torques[:swing]], t.swing_T)]
    for k, part in enumerate(t.follows):
        first = swing + k * follow
        phases.append((part.place_at, t.follow_nodes, t.torques[first : first + follow], part.T))
    for place_at, nodes, torques, duration in phases:
        for a, b, one, two in zip(nodes, nodes[1:], torques, torques[1:], strict=False):
            step, most = (two - one)[joints], _repeated(duration, len(joints)) * (rate * (b - a))
            place = place_at((a + b) / 2)
            place = replace(place, name=f"{place.name}, from {100 * a:.1f} %")
            for way, sign in (("rising", 1.0), ("falling", -1.0)):
                t.rows.add(
                    term=term.name,
                    place=place,
                    components=[f"{label} {way}" for label in labels],
                    affine=step * sign - most,
                    upper=0,
                    measure=[Measure("%", 100 / r, "over its limit", duration[0] * (b - a)) for r in rate],
                )


def _repeated(duration: Group, count: int) -> Affine:
    return duration[0].apply(np.ones((count, 1)))


def _hand_orientation(t: ContactProgram, term: HandOrientation) -> None:
    direction = t.problem.normal if term.direction is None else term.direction
    numbers = np.array([*term.axis, *direction, np.sin(term.angle)])
    at = t.add_block("hand_orientation", [[t.contact_state[0]]], numbers)
    t.rows.add(
        term=term.name,
        place=CONTACT,
        components=[t.problem.striker],
        outputs=np.array([at]),
        lower=1 / np.tan(term.angle),
        measure=degrees("too far off"),
    )


def _gaze(t: ContactProgram, term: Gaze) -> None:
    nodes = t.swing_spots(term.since)
    numbers = np.array([*term.axis, *t.problem.point, np.sin(term.angle)])
    at = t.add_block("gaze", [slots for _, slots in nodes], numbers)
    for i, (place, _) in enumerate(nodes):
        t.rows.add(
            term=term.name,
            place=place,
            components=[term.frame],
            outputs=np.array([at + i]),
            lower=1 / np.tan(term.angle),
            measure=degrees("too far off"),
        )


def _hit_region(t: ContactProgram, term: HitRegion) -> None:
    numbers = [*t.problem.point, *face_axes(t.problem.normal).ravel()]
    numbers += [] if term.radius is None else [term.radius]
    at = t.add_block("hit_region", [[t.contact_state[0]]], np.array(numbers))
    away = millimetres("away")
    t.equal("hit point", Place(CONTACT, ""), ["along the normal"], np.array([at]), away)
    names = ["disc"] if term.size is None else ["across", "up"]
    most = np.zeros(1) if term.size is None else np.array(term.size) / 2
    t.rows.add(
        term=term.name,
        place=CONTACT,
        components=names,
        outputs=at + 1 + np.arange(len(names)),
        lower=-np.inf if term.size is None else -most,
        upper=most,
        measure=millimetres("outside"),
    )


def _hit_cone(t: ContactProgram, term: HitCone) -> None:
    y, y1, _ = t.contact_state
    numbers = np.append(face_axes(t.problem.normal).ravel(), np.tan(term.angle))
    at = t.add_block("hit_cone", [[y, y1, t.contact_T]], numbers)
    t.rows.add(
        term=term.name,
        place=CONTACT,
        components=["across the normal"],
        outputs=np.array([at]),
        lower=0,
        measure=Measure("m/s", 1.0, "too fast"),
    )


_ADD: dict[type[Term], Callable[[Any, Any], None]] = {
    TorqueRate: _torque_rate,
    HandOrientation: _hand_orientation,
    Gaze: _gaze,
    HitRegion: _hit_region,
    HitCone: _hit_cone,
}
