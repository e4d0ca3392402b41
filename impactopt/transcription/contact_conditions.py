"""Conditions of the striking point at contact, its clearance from the target before and after, and balance.

The striking point must touch the target in the contact phases only. Its clearance after contact is
constrained if the target stays where it is, or if its speed after the impact is bounded, so that it may be
slow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impactopt.arrays import Array
from impactopt.kinematics.operational_space import across, striking_point
from impactopt.kinematics.stance import inward_edges, support_polygon
from impactopt.problem.objectives import AngularMomentum
from impactopt.problem.terms import HitCone, HitRegion, TargetSpeed
from impactopt.problem.violation import Measure, Place, millimetres
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.contact_state import ContactState
from impactopt.transcription.layout import Affine, Group
from impactopt.transcription.motion_phase import MotionPhase

# Distance [m] of the striking point behind the target's plane, before contact and after it. Nearer to
# contact it may be less: it grows at a rate [m/s] below the least approach speed. A point that hovers at
# the plane would touch the target between nodes.
CLEARANCE, CLEARANCE_RATE = 0.02, 0.04
SOFT_GRIP_RATE = 0.12  # [m/s] after contact, of a tool in a soft grip: in replays it swings back some mm more
APPROACH_RATE = 0.05  # [m/s] least approach speed at contact
TOO_NEAR = millimetres("too near")
TARGET_TRAVEL = "target's way after contact"  # variable


def add_balance(
    b: Builder, state: ContactState, after: list[Affine], scenarios: Sequence[Collision]
) -> Group | None:
    """Add the constraints of `Balance` after the expected target and in each scenario.

    state : at contact, from which the robot has to come to rest if the target is missing.
    after : y, y', legs and T after the expected target.

    Returns the angular momentum after the expected target as variables, if it is in the objective.
    """
    balance = b.limits.balance
    states = [(after, balance.capture_margin, "after contact")]
    for other in scenarios:
        assert other.scenario is not None
        states.append((other.state_after, other.scenario.capture_margin, f"after contact{other.suffix}"))
    for s in b.problem.scenarios:
        if s.missing:
            slots = [state.y, state.y1, state.legs, state.T]
            states.append((slots, s.capture_margin, f"contact, if {s.name}"))
    inward, offset = inward_edges(support_polygon(b.robot, b.coordinates))
    # Distance from an edge: inward . point - offset, of edges moved inwards by the margin. A state without a
    # margin has an instance too, for its speed and momentum.
    parameters = [np.column_stack([inward, offset + (margin or 0.0)]).ravel() for _, margin, _ in states]
    at = b.add_block("balance", [slots for slots, _, _ in states], np.array(parameters))
    edges = len(inward)
    wanted = any(isinstance(o, AngularMomentum) for o in b.problem.objectives)
    angular_momentum: Group | None = None
    for i, (_, margin, place) in enumerate(states):
        start = at + i * (edges + 4)  # outputs of a state: edges, vertical speed, angular momentum (3)
        if margin is not None:
            b.constraints.add(
                term="capture point",
                place=place,
                components=[f"edge {k}" for k in range(edges)],
                outputs=start + np.arange(edges),
                lower=0,
                measure=millimetres("outside"),
                whole="",
            )
        most_speed, most_momentum = balance.vertical_speed, balance.angular_momentum
        b.constraints.add(
            term="vertical speed",
            place=place,
            components=["z"],
            outputs=np.array([start + edges]),
            lower=-most_speed,
            upper=most_speed,
            measure=Measure("m/s", 1.0, "too fast"),
        )
        outputs, turning = start + edges + 1 + np.arange(3), Measure("N m s", 1.0, "too much")
        if wanted and i == 0:
            angular_momentum = b.lift(
                "angular momentum",
                outputs,
                place=place,
                labels=["x", "y", "z"],
                measure=turning,
                lower=-most_momentum,
                upper=most_momentum,
            )
            continue
        b.constraints.add(
            term="angular momentum",
            place=place,
            components=["x", "y", "z"],
            outputs=outputs,
            lower=-most_momentum,
            upper=most_momentum,
            measure=turning,
        )
    return angular_momentum


def rotation_rows(normal: Array) -> Array:
    """Rotation matrix (3, 3) whose rows are the normal and two tangents."""
    return np.vstack([normal, across(normal)])


def add_conditions(b: Builder, state: ContactState) -> None:
    """Add hit point, approach speed and incidence of each striker.

    Terms `HitRegion` and `HitCone` replace hit point and incidence.
    """
    for k, block in enumerate(["contact", "second_contact"][: len(b.problem.strikers)]):
        _add_conditions(b, state, block, k)


def _least_speed(b: Builder) -> float:
    """Least speed [m/s] of the striking point along the normal at contact."""
    return APPROACH_RATE + float(b.problem.target.speed_before())


def _add_conditions(b: Builder, state: ContactState, block: str, number: int) -> None:
    """Add the conditions of one striker.  number : of the striker.  block : its block's name."""
    p, incidence = b.problem, b.limits.incidence
    striker, point = p.contacts[number]
    prefix = f"{striker} " if number else ""
    at = b.add_block(block, [[state.y, state.y1, state.T]], rotation_rows(p.normal).ravel())
    if p.extra(HitRegion) is None:
        b.constraints.add(
            term="hit point",
            place=Place("contact", ""),
            components=[f"{prefix}{axis}" for axis in "xyz"],
            outputs=at + np.arange(3),
            lower=point,
            upper=point,
            measure=millimetres("away"),
        )
        # number of the call of `add` above
        hit_point = len(b.constraints.lower) - 1

        def update_point(b: Builder) -> None:
            at = b.problem.contacts[number][1]
            b.constraints.bound(hit_point, at, at)

        b.follow(update_point)
    b.constraints.add(
        term="approach speed",
        place="contact",
        components=[f"{prefix}normal"],
        outputs=np.array([at + 3]),
        lower=_least_speed(b),
        measure=Measure("m/s", 1.0, "too slow"),
    )
    approach = len(b.constraints.lower) - 1
    b.follow(lambda b: b.constraints.bound(approach, _least_speed(b), np.inf))
    if p.extra(HitCone) is None:
        b.constraints.add(
            term=incidence.name,
            place="contact",
            components=[f"{prefix}tangent 1", f"{prefix}tangent 2"],
            outputs=at + np.array([4, 5]),
            lower=-incidence.speed,
            upper=incidence.speed,
            measure=Measure("m/s", 1.0, "too fast across the normal"),
            whole=prefix.strip(),
        )


def add_clearance(b: Builder, swing: MotionPhase, follow: MotionPhase, state: Affine) -> None:
    """Add the clearance of all strikers from the target.

    At the nodes of the swing, and at those of the follow-through if the target stays or may be slow.

    state : of the expected target at separation.
    """
    travel = _target_travel(b, follow, state)
    for k, block in enumerate(["approach", "second_approach"][: len(b.problem.strikers)]):
        _add_clearance(b, swing, follow, block, k, travel)


def _target_travel(b: Builder, follow: MotionPhase, state: Affine) -> Affine | None:
    """Travel [m] of the target along the normal during the follow-through; None: it is not constrained."""
    if b.problem.target.stays:
        return Affine.zeros(1)
    if b.problem.extra(TargetSpeed) is None:
        return None

    def parameters(b: Builder) -> Array:
        return np.array(list(b.problem.target.parameters.values()))

    at = b.add_block("target_way", [[state, follow.T[0]]], parameters(b))
    b.follow(lambda b: b.block("target_way").take_parameters(parameters(b)))
    return b.lift(TARGET_TRAVEL, np.array([at]), place=follow.place_at(1.0), measure=millimetres("off"))[0]


def _add_clearance(
    b: Builder, swing: MotionPhase, follow: MotionPhase, block: str, number: int, travel: Affine | None
) -> None:
    """Add the clearance of one striker.  travel [m] : of the target in the follow-through."""
    # not the swing's last node, at which the striking point is at the target by "hit point"
    p, before, after, start = b.problem, swing.nodes[:-1], follow.nodes, len(b.constraints.lower)
    striker, point = b.problem.contacts[number]
    motions = [swing.at(s)[0] for s in before]
    if travel is not None:
        motions += [follow.at(s)[0] for s in after]
    first = b.add_block(block, [[y] for y in motions], p.normal)
    # the target's plane, which it reaches at contact with constant speed
    duration = float(np.mean(p.swing.duration))
    surface, speed = Affine.constant(float(p.normal @ point)), float(p.target.speed_before())
    distances = [CLEARANCE_RATE * (1 - s) * duration for s in before]
    for i, (s, distance) in enumerate(zip(before, distances, strict=True)):
        # Linear in T. The speed is a coefficient, which no update changes: with another one the program is
        # built anew (`StructuredProgram.same_parameters`).
        plane = surface - swing.T[0] * (speed * (1 - s))
        spot = first + i, swing.place_at(s), distance
        _add_plane_distance(b, "no touch before contact", number, spot, plane)
    b.follow(lambda b: _update_distances(b, number, start, distances))
    if travel is None:
        return
    # After contact the plane begins where the striking point is at the first node of the follow-through, and
    # moves with the target. A nail that coasts on only makes room.
    first, place = first + len(before), follow.place_at
    soft = any(tool.name == striker and tool.grip is not None for tool in p.robot.tools)
    behind = (SOFT_GRIP_RATE if soft else CLEARANCE_RATE) * float(np.mean(p.follow.duration))
    name = f"target left by {striker}" if number else "target left"
    # each constraint below needs this output, and an output may be in one constraint only
    there = b.lift(name, np.array([first]), place=place(0.0), measure=TOO_NEAR)[0]
    spots = [(first + i, place(s), s * behind) for i, s in enumerate(after) if i]
    left = len(b.constraints.lower)
    for s, spot in zip(after[1:], spots, strict=True):
        _add_plane_distance(b, "no touch after contact", number, spot, there + travel * float(s))
    distances_after = [distance for _, _, distance in spots]
    b.follow(lambda b: _update_distances(b, number, left, distances_after, planes=False))


def _add_plane_distance(
    b: Builder, term: str, number: int, spot: tuple[int, Place, float], plane: Affine
) -> None:
    """Constrain a striking point's distance behind the target's plane.

    spot : output of its position along the normal, place, and distance that is enough near contact [m].
    plane : position of the target's plane along the normal [m].
    """
    output, place, distance = spot
    b.constraints.add(
        term=term,
        place=place,
        components=[b.problem.contacts[number][0]],
        outputs=np.array([output]),
        affine=-plane,
        upper=-min(_most_clearance(b, number), distance),
        measure=TOO_NEAR,
    )


def _update_distances(
    b: Builder, number: int, start: int, distances: list[float], *, planes: bool = True
) -> None:
    """Update the constraints of `_add_plane_distance` from index ``start`` on to the builder's problem.

    distances : that are enough near contact [m].  planes : the plane is the target's at contact, and no
        variable.
    """
    most, surface = _most_clearance(b, number), float(b.problem.normal @ b.problem.contacts[number][1])
    for k, distance in enumerate(distances, start=start):
        b.constraints.bound(k, -np.inf, -min(most, distance))
        if planes:
            b.constraints.affine[k] = replace(b.constraints.affine[k], const=np.full(1, -surface))


def _most_clearance(b: Builder, number: int) -> float:
    """Clearance [m] of a striking point far from contact: at most its distance in the start posture."""
    p, (striker, point) = b.problem, b.problem.contacts[number]
    at = striking_point(p.robot, striker, p.start_posture)
    # a robot that starts at the target need not go back to have more clearance than it began with
    return min(CLEARANCE, max(float(p.normal @ (point - at)), 0.0))
