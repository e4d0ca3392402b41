"""The scene of a problem, as an engine gets it."""

from __future__ import annotations

from impactopt.kinematics.support import support_polygon
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.collision_geometry import FLOOR, Solid, Solids
from impactopt.simulation.result import Scene


def scene_of(problem: ImpactProblem) -> Scene:
    """Target, contact and fixed soles of ``problem``."""
    p = problem
    return Scene(
        solids=solids_of(p) if p.keeps_apart else Solids(),
        point=p.point,
        normal=p.normal,
        law=p.law,
        target=p.target,
        striker=p.robot.striker(p.striker).model_frame,
        soles=p.stance.sole_frames(p.robot),
        hands=p.stance.hand_frames(p.robot),
        second=None if p.second is None else (p.robot.striker(p.second.striker).model_frame, p.second.point),
        corners=tuple(sole.polygon for sole in p.stance.soles(p.robot)),
        polygon=support_polygon(p.robot, p.coordinates),
    )


def solids_of(problem: ImpactProblem) -> Solids:
    """The hulls of the robot's links, the bodies of the world, and which of them are not to touch."""
    bodies = problem.bodies
    pieces = bodies.links.pieces
    solids = [Solid(name=piece.link, joint=piece.joint, vertices=piece.vertices) for piece in pieces]
    number = {id(piece): k for k, piece in enumerate(pieces)}
    pairs = [(number[id(a)], number[id(b)]) for found in bodies.pairs.values() for a, b in found]
    place = dict[int, int]()
    for w, body in enumerate(bodies.world):
        if body.ground:
            place[w] = FLOOR
        if body.ground or body.core:
            continue
        place[w] = len(solids)
        solids.append(
            Solid(
                name=body.name,
                half=body.half,
                radius=body.radius,
                place=body.place,
                rotation=body.rotation,
                of_target=body.of_target,
                moves=body.moves,
                before=body.before,
            )
        )
    for joint, w in bodies.world_pairs:
        if w in place:
            pairs += [(number[id(piece)], place[w]) for piece in bodies.links.of_joint[joint]]
    height = problem.ground_height
    return Solids(solids=tuple(solids), pairs=tuple(pairs), floor=0.0 if height is None else height)
