"""Balance of the state that each target leaves behind, and of one that is missing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impactopt.kinematics.support import inward_edges, support_polygon
from impactopt.problem.objectives import AngularMomentum
from impactopt.transcription.builder import Builder
from impactopt.transcription.collision import Collision
from impactopt.transcription.constraints import Measure, millimetres
from impactopt.transcription.contact_state import ContactState
from impactopt.transcription.layout import Affine, Group


def add_balance(
    b: Builder, state: ContactState, after: list[Affine], scenarios: Sequence[Collision]
) -> Group | None:
    """Rows of all states; the angular momentum after the expected target, if an objective asks for it.

    state : at contact, which a missing target leaves.  after : y, y', legs and T after the expected target.
    """
    balance = b.limits.balance
    found = [(after, balance.capture_margin, "after contact")]
    for other in scenarios:
        assert other.scenario is not None
        found.append((other.state_after, other.scenario.capture_margin, f"after contact{other.suffix}"))
    for s in b.problem.scenarios:
        if s.missing:
            slots = [state.y, state.y1, state.legs, state.T]
            found.append((slots, s.capture_margin, f"contact, if {s.name}"))
    inward, offset = inward_edges(support_polygon(b.robot, b.coordinates))
    parameters = [np.column_stack([inward, offset + (m or 0.0)]).ravel() for _, m, _ in found]
    at = b.add_block("balance", [slots for slots, _, _ in found], np.array(parameters))
    k = len(inward)
    wanted = any(isinstance(o, AngularMomentum) for o in b.problem.objectives)
    angular_momentum: Group | None = None
    for i, (_, margin, place) in enumerate(found):
        start = at + i * (k + 4)
        if margin is not None:
            b.rows.add(
                term="capture point",
                place=place,
                components=[f"edge {e}" for e in range(k)],
                outputs=start + np.arange(k),
                lower=0,
                measure=millimetres("outside"),
                whole="",
            )
        slow, still = balance.vertical_speed, balance.angular_momentum
        b.rows.add(
            term="vertical speed",
            place=place,
            components=["z"],
            outputs=np.array([start + k]),
            lower=-slow,
            upper=slow,
            measure=Measure("m/s", 1.0, "too fast"),
        )
        outputs, turning = start + k + 1 + np.arange(3), Measure("N m s", 1.0, "too much")
        if wanted and i == 0:
            angular_momentum = b.lift(
                "angular momentum",
                outputs,
                place=place,
                labels=["x", "y", "z"],
                measure=turning,
                lower=-still,
                upper=still,
            )
            continue
        b.rows.add(
            term="angular momentum",
            place=place,
            components=["x", "y", "z"],
            outputs=outputs,
            lower=-still,
            upper=still,
            measure=turning,
        )
    return angular_momentum
