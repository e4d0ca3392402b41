"""The nonlinear pieces of an impact motion's program as CasADi functions of (variables z, parameters p).

Everything that is a number of the scene (normal, contact law, target, gains, limits) is a parameter, so one
compiled library per robot, stance and striker serves every problem.  Times and rates: y' and y'' are
derivatives in the phase's own s in [0, 1], so ydot = y'/T and yddot = y''/T^2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.kinematics.striking_point import striker_kinematics
from impactopt.problem.block import BlockExpression, make_block

__all__ = [
    "DEPTH_SCALE",
    "FORCE_SCALE",
    "RESTITUTING",
    "BlockExpression",
    "builders",
    "make_block",
    "sizes",
    "two_mass_restitution",
    "typical_state",
]

FORCE_SCALE = 100.0  # [N] contact forces in the program's rows
DEPTH_SCALE = 0.01  # [m] penetration in the program's rows
RESTITUTING = 6  # which parameter of `force` says so


def sizes(c: StanceCoordinates, target: Target, block: str) -> dict[str, int]:
    """Lengths of the named slices of a block's output, in order."""
    n, base, soles = c.robot.n, c.base, len(c.legs)
    return {
        "node": {"closure": 6 * soles, "base": base, "torque": n, "leg_rate": c.nl, "extension": soles},
        "contact": {"point": 3, "velocity": 3},
        "approach": {"along": 1},
        "coasting": {"closure": 6 * soles, "twist": 6 * soles},
        "collision": {"closure": 6 * soles, "base": base, "joints": n, "torque": n},
        "force": {
            "law": 1,
            "target": target.n_states,
            "travel": 1,
            "impulse": 1,
            "rate": 1,
            "penetration": 1,
            "separation": 1,
            "speed": 1,
            "event": int(bool(target.guards)),
            "lasting": int(bool(target.guards)),
        },
        "impact": {"base": base, "joints": n, "blow": 1},
        "join": {"travel": 1},
        "link": {"contact": 1, "position": 1, "rate": 1},
    }[block]


def node(c: StanceCoordinates) -> BlockExpression:
    """A node of a swing or follow-through: closed legs, inverse dynamics under the soles' wrenches.

    z = y, y', y'' (ny each), legs (nl), sole wrenches (6 a sole, [N, N m], in the sole's frame), T [s];
    p = torque limits (n), leg rate limits (nl), weight [N], lever [m], leg determinants in the start posture.
    out = closure [m, rad], base rows of the equation of motion over weight and weight x lever, torque over
        limit, leg rate over limit, leg determinants over those of the start posture.
    """
    ny, n = c.ny, c.robot.n
    y, y1, y2 = ca.SX.sym("y", ny), ca.SX.sym("y1", ny), ca.SX.sym("y2", ny)
    legs, w, T = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("T")
    limit, rate_limit = ca.SX.sym("limit", n), ca.SX.sym("rate_limit", c.nl)
    weight, lever, start = ca.SX.sym("weight"), ca.SX.sym("lever"), ca.SX.sym("start", len(c.legs))
    u, udot = ca.SX.sym("u", ny), ca.SX.sym("udot", ny)
    v, a = c.motion(y, legs, u, udot)
    rnea = ca.Function("rnea", [c.rb.q, c.rb.v, c.rb.a], [c.rb.rnea(c.rb.v, c.rb.a)])
    tau = rnea(c.configuration(y, legs), v, a) - c.sole_wrench_map(legs, w)
    out = {
        "closure": c.closure(y, legs),
        "base": tau[: c.base] / _base_scale(c, weight, lever),
        "torque": tau[c.base :] / limit,
        "leg_rate": _leg_part(c, v) / rate_limit,
        "extension": c.leg_determinants(legs) / start,
    }
    through = [(u, y1 / T), (udot, y2 / T**2)]
    return make_block([y, y1, y2, legs, w, T], [limit, rate_limit, weight, lever, start], out, through)


def _base_scale(c: StanceCoordinates, weight: Any, lever: Any) -> Any:
    return ca.vertcat(*[weight] * 3, *[weight * lever] * 3) if c.base else ca.SX(0, 1)


def _leg_part(c: StanceCoordinates, v: Any) -> Any:
    return ca.vertcat(*[v[c.base + int(j)] for j in c.dependent])


def contact(c: StanceCoordinates, striker: str) -> BlockExpression:
    """The striking point when it meets the target.

    z = y, y', T;  p = rotation rows (normal, two tangents: 9).

    out = point [m] (world), velocity [m/s] along the normal and the two tangents.
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
    """The striking point on its way.  z = y;  p = normal (3);  out = its coordinate along the normal [m]."""
    y, normal = ca.SX.sym("y", c.ny), ca.SX.sym("n", 3)
    zero = ca.SX.zeros(c.ny)
    q, v, _ = c.upper_motion(y, zero, zero)
    point = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[0]
    return make_block([y], [normal], {"along": ca.dot(normal, point)})


def coasting(c: StanceCoordinates) -> BlockExpression:
    """The legs of the reference that coasts through the collision: soles in place and at rest, as residuals.

    z = y0, u0 (ydot) at contact, T1, T, legs, leg rates [rad/s];  p = s (place in the phase), 1 in
        restitution else 0.
    out = pose error of the held soles [m, rad], twist of the held soles [m/s, rad/s].
    """
    y0, u0 = ca.SX.sym("y0", c.ny), ca.SX.sym("u0", c.ny)
    legs, rates = ca.SX.sym("legs", c.nl), ca.SX.sym("rates", c.nl)
    T1, T, s, after = (ca.SX.sym(name) for name in ("T1", "T", "s", "after"))
    y = y0 + u0 * (after * T1 + T * s)
    out = {"closure": c.closure(y, legs), "twist": c.sole_twists(y, legs, u0, rates)}
    return make_block([y0, u0, T1, T, legs, rates], [s, after], out, lanes=4)


def collision(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Equation of motion (6) at one collocation point of the collision.

    H, J and bias are frozen anew at the point (steps 1b to 6b).
    The servo (equation 10; 12 as rows) follows a reference that coasts at its velocity at contact:
    tau = tau_ff + Kp (phi_ref - phi) + Kd (phidot_ref - phidot).

    z = y0, u0 (ydot) at contact; legs and leg rates of the coasting reference; feed-forward over torque limit
    (n); d1, T1, d, T: y = y0 + T1 d1 + T d; u = ydot; u' (in the phase's s); legs; f [N]; w (6 a sole).
    p = normal (3), s (place in the phase), 1 in restitution else 0, Kp, Kd, torque limits (n each), weight
        [N], lever [m].
    out = closure [m, rad], base rows, joint rows over torque limit, servo torque over limit.
    """
    ny, n, nl = c.ny, c.robot.n, c.nl
    y0, u0, d1, d, u, u1 = (ca.SX.sym(s, ny) for s in ("y0", "u0", "d1", "d", "u", "u1"))
    ref_legs, ref_rates, legs = (ca.SX.sym(s, nl) for s in ("ref_legs", "ref_rates", "legs"))
    ff, w = ca.SX.sym("ff", n), ca.SX.sym("w", 6 * len(c.legs))
    T1, T, f = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("f")
    normal, s, after = ca.SX.sym("n", 3), ca.SX.sym("s"), ca.SX.sym("after")
    kp, kd, limit = ca.SX.sym("kp", n), ca.SX.sym("kd", n), ca.SX.sym("limit", n)
    weight, lever = ca.SX.sym("weight"), ca.SX.sym("lever")
    t = after * T1 + T * s
    y, ydd = ca.SX.sym("y", ny), ca.SX.sym("ydd", ny)
    v, a = c.motion(y, legs, u, ydd)
    rb = c.rb
    q = c.configuration(y, legs)
    rnea = ca.Function("rnea", [rb.q, rb.v, rb.a], [rb.rnea(rb.v, rb.a)])
    row = ca.Function("row", [rb.q], [ca.densify(rb.jacobian(f"striker:{striker}")[:3, :])])(q)
    tau = rnea(q, v, a) + ca.mtimes(row.T, normal) * f - c.sole_wrench_map(legs, w)
    # position and rate of the reference relative to the robot, by joint (the base's part is not the servo's)
    ahead = c.configuration(y0 + u0 * t - y, ref_legs - legs)[c.base :]
    faster = c.configuration(u0 - u, ref_rates - _leg_part(c, v))[c.base :]
    servo = ff + (kp * ahead + kd * faster) / limit
    out = {
        "closure": c.closure(y, legs),
        "base": tau[: c.base] / _base_scale(c, weight, lever),
        "joints": tau[c.base :] / limit - servo,
        "torque": servo,
    }
    z = [y0, u0, ref_legs, ref_rates, ff, d1, T1, d, T, u, u1, legs, f, w]
    through = [(y, y0 + T1 * d1 + T * d), (ydd, u1 / T)]
    return make_block(z, [normal, s, after, kp, kd, limit, weight, lever], out, through, lanes=4)


def force(c: StanceCoordinates, striker: str, law: ContactLaw, target: Target) -> BlockExpression:
    """Contact law and target at one collocation point (equations 14 to 17, integrated).

    z = y0; d1, T1, d, T, u as in :func:`collision`; f [N]; the target's state and its slope (in s); travel x
        of its surface, x' and x1 as d, u and d1; slope p' of the impulse.
    p = point (3), normal (3), 1 in restitution else 0, the law's parameters, the target's; of a target with
        events before them, of each phase, 1 in it else 0, and how long [s] it has to last.
    out = (f - law) / 100 N, state' - T d(state)/dt over its typical size, x' - speed [m/s], p' - T f [N s],
        approach speed [m/s], penetration / 1 cm, what is zero at separation / 100 N, speed of the target's
        surface [m/s], what is zero when its phase ends, what is not below zero while it lasts.
    """
    ny, n = c.ny, target.n_states
    y0, d1, d, u = (ca.SX.sym(s, ny) for s in ("y0", "d1", "d", "u"))
    T1, T, f = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("f")
    state, slope = ca.SX.sym("state", n), ca.SX.sym("slope", n)
    x, rate_x, x1, rate_p = (ca.SX.sym(s) for s in ("x", "rate_x", "x1", "rate_p"))
    point, normal = ca.SX.sym("point", 3), ca.SX.sym("n", 3)
    restituting, phases = ca.SX.sym("restituting"), range(len(target.phases) if target.guards else 0)
    within, shortest = ca.SX.sym("within", len(phases)), ca.SX.sym("shortest", min(len(phases), 1))
    of_law = ca.SX.sym("law", len(law.parameters))
    of_target = ca.SX.sym("target", len(target.parameters))
    y, gone = ca.SX.sym("y", ny), ca.SX.sym("gone")
    q, vel, _ = c.upper_motion(y, u, ca.SX.zeros(ny))
    place, twist, _ = striker_kinematics(c, striker)(q, vel, ca.SX.zeros(c.rb.nv))
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    numbers = {name: of_target[i] for i, name in enumerate(target.parameters)}
    pieces = [target.smooth(state, f, k, numbers) for k in phases or (0,)]
    speed, moves = ca.SX(pieces[0][0]), ca.vertcat(ca.SX(0, 1), *pieces[0][1])
    event = lasting = ca.SX(0, 1)

    def of_phase(parts: list[list[Any]]) -> Any:
        return sum((ca.vertcat(ca.SX(0, 1), *part) * within[k] for k, part in enumerate(parts) if part), 0.0)

    if target.guards:
        speed, moves = of_phase([[v] for v, _ in pieces]), of_phase([rates for _, rates in pieces])
        event = of_phase(
            [[target.guard(state, f, T - shortest, k, numbers)] for k in range(len(target.guards))]
        )
        lasting = of_phase([target.invariant(state, f, k, numbers) for k in phases])
    penetration = ca.dot(normal, place - point) - gone
    rate = ca.dot(normal, twist) - speed
    compress, restitute = (law.branch(penetration, rate, flag, named) for flag in (True, False))
    out = {
        "law": (f - ((1 - restituting) * compress + restituting * restitute)) / FORCE_SCALE,
        "target": (slope - T * moves) / np.array(typical_state(target)),
        "travel": rate_x - speed,
        "impulse": rate_p - T * f,
        "rate": rate,
        "penetration": penetration / DEPTH_SCALE,
        "separation": ca.SX(law.separation(penetration, rate, named)) / FORCE_SCALE,
        "speed": speed,
        "event": event,
        "lasting": lasting,
    }
    z = [y0, d1, T1, d, T, u, f, state, slope, x, rate_x, x1, rate_p]
    through = [(y, y0 + T1 * d1 + T * d), (gone, T1 * x1 + T * x)]
    p = [point, normal, restituting, within, shortest, of_law, of_target]
    return make_block(z, p, out, through, lanes=4)


def typical_state(target: Target) -> tuple[float, ...]:
    """Sizes of the numbers of a target's state."""
    return target.typical or (1.0,) * target.n_states


def impact(c: StanceCoordinates, striker: str) -> BlockExpression:
    """An impact in no time: impulse balance of the robot on its soles, and the law of the impulse.

    z = y; legs; u0 (ydot) at contact; its change; impulsive sole wrenches [N s, N m s]; impulse I [N s].
    p = normal (3); 1 for a given restitution, 0 for that of the contact law; that restitution; stiffness
        [N/m], damping [N s/m] of the law; 1/mass of the target [1/kg]; torque limits (n); weight [N];
        lever [m].
    out = base rows, joint rows (over torque limit), separation against approach [m/s].
    """
    ny, n = c.ny, c.robot.n
    y, u0, du = (ca.SX.sym(s, ny) for s in ("y", "u0", "du"))
    legs, w, blow = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("I")
    normal, rigid, given = ca.SX.sym("n", 3), ca.SX.sym("rigid"), ca.SX.sym("e")
    stiffness, damping, inverse_mass = ca.SX.sym("k"), ca.SX.sym("d"), ca.SX.sym("im")
    limit, weight, lever = ca.SX.sym("limit", n), ca.SX.sym("weight"), ca.SX.sym("lever")
    rb = c.rb
    q = c.configuration(y, legs)
    inertia = ca.Function("inertia", [rb.q, rb.a], [rb.rnea(None, rb.a, gravity=False)])
    row = ca.Function("row", [rb.q], [ca.densify(rb.jacobian(f"striker:{striker}")[:3, :])])(q)
    push = ca.mtimes(row.T, normal)
    change = c.velocity(y, legs, du)
    balance = inertia(q, change) + push * blow - c.sole_wrench_map(legs, w)
    lost = -ca.dot(
        push, change
    )  # speed that the impulse takes from the hand; I over it is the effective mass
    approach = ca.dot(push, c.velocity(y, legs, u0))
    stiff = damping / 2 * ca.sqrt((lost / blow + inverse_mass) / stiffness)
    e = rigid * given + (1 - rigid) * two_mass_restitution(stiff)
    out = {
        "base": balance[: c.base] / (0.1 * _base_scale(c, weight, lever)),
        "joints": balance[c.base :] / (0.1 * limit),
        "blow": blow * inverse_mass + lost - (1 + e) * approach,
    }
    p = [normal, rigid, given, stiffness, damping, inverse_mass, limit, weight, lever]
    return make_block([y, legs, u0, du, w, blow], p, out, lanes=2)


def two_mass_restitution(ratio: Any) -> Any:
    """Speed of separation over that of approach of two masses with a spring, and a damper in compression.

    ratio: the damping over the critical one, of the reduced mass: zeta = d / (2 sqrt(k mu)).
    e = exp(-zeta arccos(zeta) / sqrt(1 - zeta^2)), continued through zeta = 1 by its series.
    """
    below, above = ca.fmin(ratio, 0.99), ca.fmax(ratio, 1.01)
    x = 1 - ratio
    near = 1 + x / 3 + 2 * x**2 / 15 + 2 * x**3 / 35
    slope = ca.if_else(
        ratio < 0.99,
        ca.acos(below) / ca.sqrt(1 - below**2),
        ca.if_else(ratio > 1.01, ca.acosh(above) / ca.sqrt(above**2 - 1), near),
    )
    return ca.exp(-ratio * slope)


def join() -> BlockExpression:
    """One coordinate's way through two phases as that through one.

    z = T1, T2, d1, d2, d;  out = T1 d1 + T2 d2 - (T1 + T2) d.
    """
    T1, T2, d1, d2, d = z = [ca.SX.sym(s) for s in ("T1", "T2", "d1", "d2", "d")]
    return make_block(list(z), [], {"travel": T1 * d1 + T2 * d2 - (T1 + T2) * d})


def link() -> BlockExpression:
    """One coordinate's hand-over from swing to collision, and from the state after it to the follow-through.

    z = follow-through's first value and y', its T; swing's last value and y', its T; T1, T2; d after each
        phase; u at contact and at the end.
    """
    names = ("yf", "yf1", "Tf", "y", "y1", "Ts", "T1", "T2", "d1", "d2", "u0", "u")
    yf, yf1, Tf, y, y1, Ts, T1, T2, d1, d2, u0, u = z = [ca.SX.sym(s) for s in names]
    out = {"contact": y1 / Ts - u0, "position": yf - y - T1 * d1 - T2 * d2, "rate": yf1 / Tf - u}
    return make_block(list(z), [], out)


def balance(c: StanceCoordinates, edges: int) -> BlockExpression:
    """What is left after the impact.

    The capture point [m], the vertical speed of the CoM [m/s], the angular momentum [N m s].
    z = y, y', legs, T;  p = the support polygon's edges (inward normal, offset: 3 an edge).  out = distance
    of the capture point c + cdot sqrt(c_z / g) (Koolen et al., IJRR 2012) from each edge, positive inside;
    vertical speed; angular momentum.
    """
    y, y1, legs, T = ca.SX.sym("y", c.ny), ca.SX.sym("y1", c.ny), ca.SX.sym("legs", c.nl), ca.SX.sym("T")
    rb, u = c.rb, ca.SX.sym("u", c.ny)
    momentum = ca.Function("momentum", [rb.q, rb.v], [rb.com(), rb.centroidal_momentum(rb.v)])
    com, h = momentum(c.configuration(y, legs), c.velocity(y, legs, u))
    mass = sum(i.mass for i in c.model.inertias)
    velocity = h[:3] / mass
    capture = com[:2] + velocity[:2] * ca.sqrt(com[2] / 9.81)
    polygon = ca.SX.sym("polygon", 3 * edges)
    e = ca.reshape(polygon, 3, edges).T
    out = {"capture": ca.mtimes(e[:, :2], capture) - e[:, 2], "vertical": velocity[2], "angular": h[3:]}
    return make_block([y, y1, legs, T], [polygon], out, [(u, y1 / T)], lanes=2)


def builders(
    c: StanceCoordinates,
    striker: str,
    law: ContactLaw,
    target: Target,
    edges: int,
    *,
    instant: bool = False,
) -> dict[str, Callable[[], BlockExpression]]:
    """Block's name -> a function that builds its expression; ``instant``: for an impact without duration.

    That is slow: it is only called when the compiled library is not in the cache.
    """
    hit: dict[str, Callable[[], BlockExpression]] = {
        "collision": lambda: collision(c, striker),
        "force": lambda: force(c, striker, law, target),
    }
    if c.legs:
        hit["coasting"] = lambda: coasting(c)
    if target.guards:
        hit["join"] = join
    return {
        "node": lambda: node(c),
        "contact": lambda: contact(c, striker),
        "approach": lambda: approach(c, striker),
        **({"impact": lambda: impact(c, striker)} if instant else hit),
        "link": link,
        **({"balance": lambda: balance(c, edges)} if c.legs else {}),
    }
