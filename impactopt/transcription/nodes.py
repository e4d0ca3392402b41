"""Nodes of the ways before and after contact: the equation of motion, the legs and the soles' wrenches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impactopt.kinematics.support import contact_wrench_cone
from impactopt.transcription.builder import Builder
from impactopt.transcription.constraints import Index, Measure, Place, along, percent
from impactopt.transcription.layout import Affine, Array
from impactopt.transcription.limits import DIRECTIONS


def add_nodes(
    b: Builder, instances: list[list[Affine]], places: Sequence[Place | str], *, closed: int = 0
) -> list[Index]:
    """Nodes of the block ``node`` with their constraints, but for those of torque; the torques' outputs.

    instances : y, y', y'', legs, sole wrench, T of each.  closed : so many of the last have the posture
    of another, whose constraints close their legs.
    """
    c, part = b.coordinates, b.parts("node")
    limits, rates = b.robot.torque_limit, b.robot.velocity_limit[c.dependent]
    numbers = np.concatenate([limits, rates, b.limits.units, c.start_determinants])
    first, torques = b.add_block("node", instances, numbers), []
    closure = [f"{leg.end} {d}" for leg in c.legs for d in DIRECTIONS]
    fast = percent("over its limit", of=b.limits.velocity.fraction)
    for i, (place, slots) in enumerate(zip(places, instances, strict=True)):
        at = first + i * b.blocks[-1].n_out
        for term, name, components, bound, measure in (
            ("closed legs", "closure", closure, 0.0, along(closure, "open")),
            (b.limits.velocity.name, "leg_rate", c.leg_labels, b.limits.velocity.fraction, fast),
            ("equation of motion of the base", "base", DIRECTIONS[: c.base], 0.0, b.limits.unbalanced),
        ):
            if name == "closure" and i >= len(instances) - closed:
                continue
            b.rows.add(
                term=term,
                place=place,
                components=components,
                outputs=at + part[name],
                lower=-bound,
                upper=bound,
                measure=measure,
            )
        b.rows.add(
            term=b.limits.extension.name,
            place=place,
            components=[leg.limb for leg in c.legs],
            outputs=at + part["extension"],
            lower=b.limits.extension.minimum,
            measure=percent("too near to straight", of=b.limits.extension.minimum),
        )
        add_cone_rows(b, slots[4], place, b.limits.cone.margin, b.limits.cone.minimum_force)
        torques.append(at + part["torque"])
    return torques


def add_cone_rows(
    b: Builder, wrench: Affine, place: Place | str, margin: float, minimum_force: float
) -> None:
    """Rows: each sole's wrench (6 a sole) is in its cone, its normal force [N] no less than the least."""
    for k, leg in enumerate(b.coordinates.legs):
        if leg.sole is None:  # a hand: see `Grip`
            continue
        w = wrench[6 * k : 6 * k + 6]
        rows = contact_wrench_cone(leg.sole.polygon, b.limits.cone.friction, margin=margin) / b.limits.weight
        normal, sole = w[2:3] * (1 / b.limits.weight), leg.end
        b.rows.add(
            term=b.limits.cone.name,
            place=place,
            components=[f"{sole}, facet {i}" for i in range(len(rows))],
            affine=w.apply(rows),
            lower=0,
            measure=[_outside_cone(row * b.limits.weight, normal, b.limits.cone.friction) for row in rows],
            whole=sole,
        )
        b.rows.add(
            term="normal force",
            place=place,
            components=[sole],
            affine=normal,
            lower=minimum_force / b.limits.weight,
            measure=Measure("N", b.limits.weight, "too light"),
        )


def _outside_cone(facet: Array, normal: Affine, friction: float) -> Measure:
    """Measure of a facet (6,) of the cone of corners' forces; ``normal``: normal force over weight."""
    along_sole, tilting = np.hypot(*facet[:2]), np.hypot(*facet[3:5])
    if along_sole < 1e-9 and abs(facet[5]) < 1e-9:
        return Measure("mm", 1e3 / tilting, "outside", normal, 0.05)  # moment over force: the CoP
    if tilting < 1e-9 and abs(facet[5]) < 1e-9:
        return Measure("%", 100 / along_sole / friction, "beyond its friction", normal, 0.05)
    return Measure("%", 100 / max(facet[2], 1e-3), "beyond its friction and torsion", normal, 0.05)
