"""First touch of the striking link: by its striking point, with its face to the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.arrays import Array
from impactopt.bodies.robot_bodies import StrikerFace, striker_face
from impactopt.contact.fields import described
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term
from impactopt.problem.terms.hand_orientation import HandOrientation
from impactopt.problem.violation import degrees, millimetres

# [s] The constraints hold in this time before contact. Earlier, only the striking point stays behind the
# target's plane.
SINCE = 0.12
NAMES = ("first_touch", "second_first_touch")  # names of the blocks, one for each striker


@dataclass(frozen=True, kw_only=True)
class FirstTouch(Term):
    """The striking link touches the target with its striking point, not with another part before it.

    Until contact no corner of the link's hull is farther than `depth` beyond the target's plane, beside what
    it sticks out beyond the striking point. At contact the link's face is turned along the normal. The face
    is the one with the striking point, or the one that `HandOrientation` turns to the target. Links without a
    known shape have these constraints only with `assumed`. There are none if `KeepOut` is off.
    """

    name: ClassVar[str] = "first touch"
    unit: ClassVar[str] = "m"
    depth: float = described(
        1.5e-3, "largest distance of the link's hull beyond the target's plane", unit="m", above=0
    )
    angle: float = described(0.6, "largest angle between the link's face and the normal", unit="rad", above=0)
    assumed: bool = described(False, "true: of links of unknown shape, too, as boxes of inertia")
    enabled: bool = described(True, "false: other parts of the link may touch first")

    def __post_init__(self) -> None:
        self.check_angle()
        super().__post_init__()

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        return {
            name: BlockRecipe(lambda striker=striker: ahead(coordinates, striker), (striker,))
            for name, striker in zip(NAMES, problem.strikers, strict=False)
            if face_of(problem, striker) is not None
        }

    def add_constraints(self, program: Any) -> None:
        p, spots = program.problem, late_spots(program)
        for number, (name, (striker, _)) in enumerate(zip(NAMES, p.contacts, strict=False)):
            face = face_of(p, striker)
            if face is None:
                continue
            # outputs of the block at a node: the corners' distances, and the cosine of the face's direction
            vectors = np.vstack([face.corners, face.normal / np.sin(self.angle)])
            is_point = np.append(np.ones(len(face.corners)), 0.0)
            each = [vectors, is_point[:, None]]

            def numbers(b: Any, each: Any = each, number: int = number) -> Array:
                plane = np.append(b.problem.normal, b.problem.contacts[number][1])
                return np.tile(np.hstack([np.tile(plane, (len(each[0]), 1)), *each]), (len(spots), 1))

            slots = [[slots[0]] for _, slots in spots for _ in vectors]
            at = program.add_block(name, slots, numbers(program.builder))
            program.builder.follow(
                lambda b, name=name, numbers=numbers: b.block(name).take_parameters(numbers(b))
            )
            for k, (place, _) in enumerate(spots):
                outputs = at + k * len(vectors) + np.arange(len(vectors))
                program.constraints.add(
                    term=self.name,
                    place=place,
                    components=[f"{striker}, corner {i}" for i in range(len(face.corners))],
                    outputs=outputs[:-1],
                    upper=self.depth + face.ahead,
                    measure=millimetres("beyond the target's plane"),
                    whole=striker,
                )
            program.constraints.add(
                term=self.name,
                place=spots[-1][0],
                components=[f"{striker}'s face"],
                outputs=outputs[-1:],
                lower=1 / np.tan(self.angle),
                measure=degrees("too far off"),
            )


def face_of(problem: Any, striker: str) -> StrikerFace | None:
    """Face of a striker that touches the target; None without a shape, or if `KeepOut` is off."""
    if not problem.keep_out.enabled:
        return None
    turned = problem.extra(HandOrientation) if striker == problem.striker else None
    axis = np.array(turned.axis) if turned is not None and turned.direction is None else None
    return striker_face(problem.robot, striker, axis, assumed=problem.term(FirstTouch).assumed)


def late_spots(program: Any) -> list[Any]:
    """Places of the last 0.12 s of the swing, with their slots; contact alone if the target moves before
    it.
    """
    p = program.problem
    since = max(0.0, 1 - SINCE / float(np.mean(p.swing.duration)))
    return list(program.swing_spots(1.0 if p.target.speed_before() else since))


def ahead(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Distance of a point of the striking link beyond the target's plane, or cosine of a direction to the
    normal.

    z = y;  p = normal (3), hit point (3) [m], vector (3) in the striker's frame: point [m] or direction, 1
    for a point and 0 for a direction;  out = distance [m] or cosine.
    """
    y, normal, hit = ca.SX.sym("y", c.ny), ca.SX.sym("n", 3), ca.SX.sym("hit", 3)
    vector, is_point = ca.SX.sym("d", 3), ca.SX.sym("point")
    zero = ca.SX.zeros(c.ny)
    rotation, origin = c.rb_frame(f"striker:{striker}", c.upper_motion(y, zero, zero)[0])
    out = ca.dot(normal, is_point * (origin - hit) + ca.mtimes(rotation, vector))
    return make_block([y], [normal, hit, vector, is_point], {"along": out})
