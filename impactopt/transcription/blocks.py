"""Nonlinear functions of a motion's program as CasADi expressions of variables z and parameters p.

All parameters of the scene (normal, contact law, target, gains, limits) are in p, so one compiled library per
robot, stance and striker serves every problem. y' and y'' are derivatives in the phase's own s in [0, 1]:
ydot = y'/T and yddot = y''/T^2. Lists of z, p and out are in the order of the vectors' parts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca

from impactopt.contact.fields import IS_NAN, has_nan
from impactopt.contact.friction import moves_target
from impactopt.errors import InputError
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.kinematics.stages import Stage, motion_in_stages, velocity_in_stages
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.objectives import Objective
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import Term
from impactopt.transcription.contact_blocks import (
    SECOND,
    JointGroups,
    base_scale,
    carried,
    coasting,
    collision,
    first_instant,
    force,
    impact,
    join,
    leg_part,
    moved,
    with_gain_factors,
)
from impactopt.transcription.mesh import Elements, contact_mesh


def sizes(c: StanceCoordinates, problem: ImpactProblem, block: str) -> dict[str, int]:
    """Lengths of the named slices of a block's output at these coordinates, in order."""
    n, base, soles = c.robot.n, c.base, len(c.legs)
    frozen, second = problem.frozen is not None, problem.second is not None
    friction, guarded = problem.friction, int(bool(problem.target.guards))
    legs = {"legs": c.nl, "lag": c.nl, "hand": 1} if frozen else {}
    bent = {"bristles": 3 + 3 * second} if friction is not None and friction.bristles else {}
    bent |= {"tangential": 3} if moves_target(friction) else {}
    coasting = {"rate": c.nl, "acceleration": c.nl} if frozen else {"twist": 6 * soles}
    return {
        "node": {"closure": 6 * soles, "base": base, "torque": n, "leg_rate": c.nl, "extension": soles},
        "contact": {"point": 3, "velocity": 3},
        "approach": {"along": 1},
        "coasting": {"closure": 6 * soles, **coasting},
        "collision": {"closure": 6 * soles, "base": base, "joints": n, "torque": n, **bent, **legs},
        "moved": {"y": c.ny, "speed": 1},
        "carried": {"base": base},
        "force": {
            "law": 1,
            "target": problem.target.n_states,
            "travel": 1,
            "impulse": 1,
            "rate": 1,
            "penetration": 1,
            "separation": 1,
            "speed": 1,
            "event": guarded,
            "invariant": guarded,
            "reserve": guarded,
            **(dict.fromkeys(SECOND, 1) if second else {}),
        },
        "impact": {"base": base, "joints": n, "blow": 1},
        "spring": {"torque": c.ny - base},
        "first": {"base": base, "joints": n, "law": 1, "rotors": n},
        "join": {"travel": 1},
        "link": {"contact": 1, "position": 1, "rate": 1},
        "pace": {"rate": 1},
        "momentum": {"momentum": base},
    }[block]


def node(c: StanceCoordinates) -> BlockExpression:
    """Closure of the legs and inverse dynamics under the soles' wrenches, at a node of a motion.

    z = y, y', y'' (ny, each); legs (nl,); sole wrenches (6 a sole, [N, N m], in the sole's frame); T [s].
    p = torque limits (n,); leg rate limits (nl,); weight [N]; lever [m]; leg determinants at the start.
    out = closure [m, rad]; base equations over weight and weight x lever; torque over limit; leg rates over
        limits; leg determinants over those at the start.
    """
    ny, n = c.ny, c.robot.n
    y, y1, y2 = ca.SX.sym("y", ny), ca.SX.sym("y1", ny), ca.SX.sym("y2", ny)
    legs, w, T = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("T")
    limit, rate_limit = ca.SX.sym("limit", n), ca.SX.sym("rate_limit", c.nl)
    weight, lever, start = ca.SX.sym("weight"), ca.SX.sym("lever"), ca.SX.sym("start", len(c.legs))
    u, udot = ca.SX.sym("u", ny), ca.SX.sym("udot", ny)
    v, a, stages = motion_in_stages(c, y, legs, u, udot)
    # `rb` has symbols of its own: a call of a Function puts this node's q, v, a in their place.
    rnea = ca.Function("rnea", [c.rb.q, c.rb.v, c.rb.a], [c.rb.rnea(c.rb.v, c.rb.a)])
    tau = rnea(c.configuration(y, legs), v, a) - c.sole_wrench_map(y, legs, w)
    out = {
        "closure": c.closure(y, legs),
        # no actuator drives the base, so the first 6 equations have to be zero; the others give the torques
        "base": tau[: c.base, :] / base_scale(c, weight, lever),
        "torque": tau[c.base :] / limit,
        "leg_rate": leg_part(c, v) / rate_limit,
        "extension": c.leg_determinants(legs) / start,
    }
    # u and udot are a stage: y', y'' and T enter through them only, which keeps the Hessian by them short
    through = [(u, y1 / T), (udot, y2 / T**2)]
    p = [limit, rate_limit, weight, lever, start]
    return make_block([y, y1, y2, legs, w, T], p, out, through, stages=stages)


def contact(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Striking point at contact.

    z = y; y'; T.  p = normal and two tangents (9).
    out = point [m] (world); velocity [m/s] along the normal and the two tangents.
    """
    y, y1, T = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T")
    axes = ca.SX.sym("axes", 9)
    q, v, _ = c.upper_motion(y, y1 / T, ca.SX.zeros(c.ny))
    point, twist, _ = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))
    return make_block(
        [y, y1, T],
        [axes],
        {"point": point, "velocity": ca.mtimes(ca.reshape(axes, 3, 3).T, twist)},
        lanes=2,
    )


def approach(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Position of the striking point along the normal [m].  z = y.  p = normal (3,)."""
    y, normal = ca.SX.sym("y", c.ny), ca.SX.sym("n", 3)
    zero = ca.SX.zeros(c.ny)
    q, v, _ = c.upper_motion(y, zero, zero)
    point = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[0]
    return make_block([y], [normal], {"along": ca.dot(normal, point)})


def link() -> BlockExpression:
    """Continuity of one coordinate from the swing through the collision to the follow-through.

    z = y, y' and T at the beginning of the follow-through; y, y' and T at the end of the swing; T1; T2; mean
        rates d1, d2 in these two phases; ydot at contact; ydot after it.
    out = residuals of the rate at contact, and of position and rate after it.
    """
    # One coordinate an instance: its Hessian is 12 x 12 at most, where that of all ny together would be
    # mostly zeros.
    names = ("yf", "yf1", "Tf", "y", "y1", "Ts", "T1", "T2", "d1", "d2", "u0", "u")
    yf, yf1, Tf, y, y1, Ts, T1, T2, d1, d2, u0, u = z = [ca.SX.sym(s) for s in names]
    out = {"contact": y1 / Ts - u0, "position": yf - y - T1 * d1 - T2 * d2, "rate": yf1 / Tf - u}
    return make_block(list(z), [], out)


def pace() -> BlockExpression:
    """Rate of one coordinate.  z = y'; T.  out = ydot."""
    y1, T = ca.SX.sym("y1"), ca.SX.sym("T")
    return make_block([y1, T], [], {"rate": y1 / T})


def corner_heights(c: StanceCoordinates, frame: str, corners: int) -> BlockExpression:
    """Corners of a sole that is not fixed.

    z = y.  p = its corners in its frame [m] (2 each).
    out = their heights [m]; position of its frame, x and y [m].
    """
    y, zero, p = ca.SX.sym("y", c.ny), ca.SX.zeros(c.ny), ca.SX.sym("corners", 2 * corners)
    q, _, _ = c.upper_motion(y, zero, zero)
    rotation, point = c.rb_frame(frame, q)
    # rotation[2, :2]: heights of the frame's x and y axes; a corner is x, y in the sole's plane
    heights = ca.mtimes(ca.reshape(p, 2, corners).T, rotation[2, :2].T) + point[2]
    return make_block([y], [p], {"height": heights, "place": point[:2]})


def spring(c: StanceCoordinates, gain_groups: JointGroups = ()) -> BlockExpression:
    """Torques of springs and dampers at joints outside the constrained legs, minus those at rest.

    gain_groups : joints that share a factor on stiffness and damping.

    z = y; y'; T; logarithms of the factors.  p = angles at rest; stiffness and damping over torque limit, one
        a joint.
    out = torques over limit.
    """
    m = c.ny - c.base
    y, y1, T = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T")
    # joints of the closed legs have no spring here: only coordinates y are independent
    rest, stiffness, damping = ca.SX.sym("rest", m), ca.SX.sym("k", m), ca.SX.sym("d", m)
    logs, place = ca.SX.sym("logs", len(gain_groups)), {int(j): k for k, j in enumerate(c.independent)}
    # from joints of the robot to those of this block, which has none of the closed legs
    groups = tuple(tuple(place[j] for j in joints if j in place) for joints in gain_groups)
    scaled_stiffness, scaled_damping = with_gain_factors(stiffness, damping, logs, groups)
    torque = -scaled_stiffness * (y[c.base :] - rest) - scaled_damping * y1[c.base :] / T
    return make_block([y, y1, T, logs], [rest, stiffness, damping], {"torque": torque})


def balance(c: StanceCoordinates, edges: int) -> BlockExpression:
    """Balance after the impact: capture point, vertical speed and angular momentum.

    z = y; y'; legs; T.  p = edges of the support polygon (inward normal and offset, 3 an edge).
    out = distance of the capture point c + cdot sqrt(c_z / g) (Koolen et al., IJRR 2012) from each edge [m],
        positive inside; vertical speed of the centre of mass [m/s]; angular momentum about it [N m s].
    """
    y, y1, legs, T = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("legs", c.nl), ca.SX.sym("T")
    rb, u = c.rb, ca.SX.sym("u", c.ny)
    momentum = ca.Function("momentum", [rb.q, rb.v], [rb.com(), rb.centroidal_momentum(rb.v)])
    v, stages = velocity_in_stages(c, y, legs, u)
    com, h = ca.SX.sym("com", 3), ca.SX.sym("h", 6)
    stages.append(Stage(ca.vertcat(com, h), ca.vertcat(*momentum(c.configuration(y, legs), v))))
    mass = sum(i.mass for i in c.model.inertias)
    # Pinocchio's order: h = linear (3), angular (3). Gravity's z is negative in the root below.
    velocity = h[:3] / mass
    capture = com[:2] + velocity[:2] * ca.sqrt(-com[2] / float(c.model.gravity.linear[2]))
    polygon = ca.SX.sym("polygon", 3 * edges)
    e = ca.reshape(polygon, 3, edges).T
    out = {"capture": ca.mtimes(e[:, :2], capture) - e[:, 2], "vertical": velocity[2], "angular": h[3:]}
    return make_block([y, y1, legs, T], [polygon], out, [(u, y1 / T)], lanes=2, stages=stages)


def momentum(c: StanceCoordinates) -> BlockExpression:
    """Momentum of a robot that floats freely.

    z = y; y'; T.  p = weight [N]; lever [m].
    out = linear momentum, and angular momentum about the centre of mass, world axes, over weight and weight x
        lever [s].
    """
    y, y1, T, u = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("T"), ca.SX.sym("u", c.ny)
    rb, none = c.rb, ca.SX(0, 1)
    weight, lever = ca.SX.sym("weight"), ca.SX.sym("lever")
    found = ca.Function("momentum", [rb.q, rb.v], [rb.centroidal_momentum(rb.v)])
    v, stages = velocity_in_stages(c, y, none, u)
    out = found(c.configuration(y, none), v) / base_scale(c, weight, lever)
    return make_block([y, y1, T], [weight, lever], {"momentum": out}, [(u, y1 / T)], stages=stages)


def own_blocks(problem: ImpactProblem, edges: int = 0) -> dict[str, Callable[[], BlockExpression]]:
    """Functions that build the expressions of the blocks which every program of this problem has, by name.

    They are slow, and are called only if the compiled library is not in the cache.

    edges : of the support polygon.
    """
    c, striker, frozen, second = problem.coordinates, problem.striker, problem.frozen, problem.second
    gain_groups = problem.gain_joints
    friction = 0 if problem.friction is None else len(problem.friction.parameters)
    moves = moves_target(problem.friction)
    other = "" if second is None else second.striker
    lasting: dict[str, Callable[[], BlockExpression]] = {
        "collision": lambda: collision(c, striker, frozen, other, gain_groups, friction, moves),
        "force": lambda: force(c, striker, problem.law, problem.target, frozen, other),
    }
    if c.legs:
        lasting["coasting"] = lambda: coasting(c, frozen)
    if c.legs and frozen is not None and not frozen.bias:
        lasting["carried"] = lambda: carried(c)
    if frozen is not None:
        lasting["moved"] = lambda: moved(c, striker)
    if frozen is not None and frozen.jdot and not problem.freezes:
        # one freeze, at the velocity v_meet, which an impact without rebound determines (`FrozenCollision`)
        lasting["impact"] = lambda: impact(c, striker)
    if problem.target.guards:
        lasting["join"] = join
    if second is not None:
        lasting["second_contact"] = lambda: contact(c, other)
        lasting["second_approach"] = lambda: approach(c, other)
    if problem.first_instant:
        lasting["first"] = lambda: first_instant(c, striker, problem.law, friction)
    return {
        "node": lambda: node(c),
        "contact": lambda: contact(c, striker),
        "approach": lambda: approach(c, striker),
        **(lasting if problem.lasts else {"impact": lambda: impact(c, striker)}),
        "link": link,
        **({"balance": lambda: balance(c, edges)} if c.legs else {}),
        **({"momentum": lambda: momentum(c)} if c.drifts else {}),
        **({"spring": lambda: spring(c, gain_groups)} if c.robot.sprung.any() else {}),
    }


def stance_blocks(
    problem: ImpactProblem,
) -> dict[str, tuple[StanceCoordinates, Callable[[], BlockExpression]]]:
    """Coordinates and build function of each block of a problem's stance phases, by name."""
    out: dict[str, tuple[StanceCoordinates, Callable[[], BlockExpression]]] = {}
    for k, c in enumerate(problem.stance_coordinates if problem.stances else ()):
        out["pace"] = problem.coordinates, pace
        if c is not problem.coordinates:
            out[f"stance{k}_node"] = c, partial(node, c)
        for i, sole in enumerate(problem.soles):
            if sole not in c.soles:
                heights = partial(corner_heights, c, sole.frame, len(sole.polygon))
                out[f"stance{k}_heights{i}"] = c, heights
    return out


@dataclass(frozen=True)
class ExtraBlock:
    """Block of a term or an objective.

    key : all that shapes the expression beside robot, stance and striker.  build : makes the expression.
    user : its name is a user's.
    """

    key: tuple[Any, ...]
    build: Callable[[], BlockExpression]
    user: bool = False


def extra_blocks(problem: ImpactProblem, elements: Elements = ()) -> dict[str, ExtraBlock]:
    """Blocks of the problem's objectives and terms, by name.

    elements : of the contact; (): the problem's.

    Raises
    ------
    InputError : a name that is taken, or is no function's name; something other than a block.
    """
    taken = {*own_blocks(problem)}
    out: dict[str, ExtraBlock] = {}
    sources: list[Term | Objective] = [*problem.objectives, *problem.active_terms]
    # the package's first, so that a name that is taken is reported of the user's class
    for source in sorted(sources, key=lambda s: not type(s).__module__.startswith("impactopt.")):
        where = f"{type(source).__name__}.blocks"
        made = source.blocks(problem, problem.coordinates)
        if not isinstance(made, Mapping):
            raise InputError(f"{where} gives {made!r}; give a dict of blocks by name, {{}} for none")
        for name, block in made.items():
            if not isinstance(block, (BlockExpression, BlockRecipe)):
                raise InputError(
                    f"{where}: {name!r} is {block!r}; give what impactopt.problem.block.make_block makes"
                )
            if name in taken or name in out:
                raise InputError(f"{where}: there is a block {name!r} already; give it another name")
            if not ca.Function.check_name(name):
                raise InputError(f"{where}: {name!r} is no name for a function; give letters, digits and _")
            out[name] = _extra(f"{where}: {name!r}", block, problem, elements)
    return out


def _extra(
    where: str, block: BlockExpression | BlockRecipe, problem: ImpactProblem, elements: Elements
) -> ExtraBlock:
    if isinstance(block, BlockExpression):
        inside = ca.vertcat(block.out, *(stage.expression for stage in block.through))
        known = ca.vertcat(block.z, block.p, *(stage.symbols for stage in block.through))
        if free := {str(s) for s in ca.symvar(inside)} - {str(s) for s in ca.symvar(known)}:
            raise InputError(
                f"{where} has symbols that are neither in its variables nor in its parameters: "
                f"{', '.join(sorted(free))}; give them to make_block, or replace them by casadi.substitute"
            )
        if has_nan(inside):
            raise InputError(f"{where} {IS_NAN}")
        return ExtraBlock(key_of(block), lambda: block, user=True)
    if block.of_stages:
        stages = len(contact_mesh(problem, elements))
        return ExtraBlock((*block.key, stages), partial(block.build, stages))
    return ExtraBlock(block.key, block.build)


def key_of(block: BlockExpression) -> tuple[Any, ...]:
    """Hash of a block's expression: the cache key of a user's block, whose source is not hashed."""
    stages = [stage.symbols for stage in block.through], [stage.expression for stage in block.through]
    # a stage's symbols are free in `out`, so here they are inputs, and their expressions outputs
    graph = ca.Function("block", [block.z, block.p, *stages[0]], [block.out, *stages[1]])
    return hashlib.sha256(graph.serialize().encode()).hexdigest(), block.lanes
