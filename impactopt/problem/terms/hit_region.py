"""Region of allowed hit points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.bodies.world import face_axes
from impactopt.contact.fields import described
from impactopt.errors import InputError, check_array
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term
from impactopt.problem.violation import Place, millimetres

REACH = 0.2  # [m] from the hit point to the edge of the largest region


@dataclass(frozen=True, kw_only=True)
class HitRegion(Term):
    """The hit point may be anywhere in a disc or a rectangle about `point_m`; give one of the two keys.

    The region is in the plane across the normal, with the axes of :func:`impactopt.bodies.world.face_axes`.
    It reaches no farther than 0.2 m. The face of the target in replays ends 0.2 m beyond it.
    """

    name: ClassVar[str] = "hit region"
    unit: ClassVar[str] = "m"
    radius: float | None = described(None, "radius of the disc", unit="m", above=0)
    size: tuple[float, float] | None = described(None, "sides of the rectangle, across and up", unit="m")

    def __post_init__(self) -> None:
        if (self.radius is None) == (self.size is None):
            raise InputError("HitRegion: give either radius, of a disc, or size, of a rectangle [m]")
        super().__post_init__()
        given: Any = self.size if self.radius is None else [self.radius]
        lengths = check_array("HitRegion [m]", given, (None,))
        if len(lengths) != (1 if self.size is None else 2) or not (lengths > 0).all() or self.reach > REACH:
            raise InputError(
                f"HitRegion of {lengths.tolist()} m: give lengths > 0 that reach no further than {REACH} m "
                "from the point"
            )
        if self.size is not None:
            object.__setattr__(self, "size", (float(lengths[0]), float(lengths[1])))

    @property
    def reach(self) -> float:
        """Distance [m] of its edge, or of its corners, from the hit point."""
        return float(np.linalg.norm(self.size)) / 2 if self.size is not None else float(self.radius or 0.0)

    def blocks(self, problem: Any, coordinates: StanceCoordinates) -> dict[str, BlockRecipe]:
        disc = self.size is None
        return {"hit_region": BlockRecipe(lambda: hit_region(coordinates, problem.striker, disc), (disc,))}

    def add_constraints(self, program: Any) -> None:
        """Add the constraints, which replace those of a fixed hit point."""

        def numbers(problem: Any) -> Any:
            size = [] if self.radius is None else [self.radius]
            return np.array([*problem.point, *face_axes(problem.normal).ravel(), *size])

        at = program.add_block("hit_region", [[program.contact_state[0]]], numbers(program.problem))
        program.builder.follow(lambda b: b.block("hit_region").take_parameters(numbers(b.problem)))
        off_plane = millimetres("away")
        program.equal("hit point", Place("contact", ""), ["along the normal"], np.array([at]), off_plane)
        names = ["disc"] if self.size is None else ["across", "up"]
        most = np.zeros(1) if self.size is None else np.array(self.size) / 2
        program.constraints.add(
            term=self.name,
            place="contact",
            components=names,
            outputs=at + 1 + np.arange(len(names)),
            lower=-np.inf if self.size is None else -most,
            upper=most,
            measure=millimetres("outside"),
        )


def hit_region(c: StanceCoordinates, striker: str, disc: bool) -> BlockExpression:
    """Offset of the striking point from the hit point.

    z = y;  p = point (3), axes of the face (9, row by row), radius of a disc;
    out = offset along the normal [m]; and offsets across and up [m], or for a disc
    (r^2 - radius^2) / (2 radius) [m] with r the offset in the plane.
    """
    y, point, axes = ca.SX.sym("y", c.ny), ca.SX.sym("point", 3), ca.SX.sym("axes", 9)
    radius, zero = ca.SX.sym("radius", int(disc)), ca.SX.zeros(c.ny)
    q, v, _ = c.upper_motion(y, zero, zero)
    at = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[0]
    offset = ca.mtimes(ca.reshape(axes, 3, 3).T, at - point)
    side = (ca.sumsqr(offset[1:]) - radius**2) / (2 * radius) if disc else offset[1:]
    return make_block([y], [point, axes, radius], {"depth": offset[0], "side": side}, lanes=2)
