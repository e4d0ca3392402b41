"""The nonlinear pieces of a contact as CasADi functions of (variables z, parameters p): see `blocks`.

One set of functions serves all models of the collision: what is frozen is a point of the contact of its own,
given to the same rigid-body functions. Numbers of steps and equations are the paper's.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from impactopt.collision.settings import Effects
from impactopt.contact.friction import pushed_way
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.kinematics.stages import Stage, motion_in_stages
from impactopt.problem.block import BlockExpression, make_block

__all__ = [
    "DEPTH_SCALE",
    "FORCE_SCALE",
    "RESTITUTING",
    "SECOND",
    "Joints",
    "base_scale",
    "carried",
    "chosen_gains",
    "coasting",
    "collision",
    "first_instant",
    "force",
    "impact",
    "join",
    "leg_part",
    "moved",
    "two_mass_restitution",
    "typical_state",
]

FORCE_SCALE = 100.0  # [N] contact forces in the program's constraints
DEPTH_SCALE = 0.01  # [m] penetration in the program's constraints
SECOND = ("second law", "second rate", "second penetration", "second separation")  # outputs of `force`
RESTITUTING = 6  # which parameter of `force` says so
Joints = tuple[tuple[int, ...], ...]  # of each factor, their places among the gains


def base_scale(c: StanceCoordinates, weight: Any, lever: Any) -> Any:
    """Scale of the base's equations: the weight [N], and for moments the weight times the lever [m]."""
    return ca.vertcat(*[weight] * 3, *[weight * lever] * 3) if c.base else ca.SX(0, 1)


def leg_part(c: StanceCoordinates, v: Any) -> Any:
    """Entries of the constrained legs' joints (nl), out of (nv)."""
    return ca.vertcat(*[v[c.base + int(j)] for j in c.dependent])


def coasting(c: StanceCoordinates, frozen: Effects | None = None) -> BlockExpression:
    """The legs of the reference that coasts through the collision: soles in place and at rest, as residuals.

    z = y0, u0 (ydot) at contact, T1, T, legs, leg rates [rad/s], of a freeze their accelerations [rad/s^2];
    p = s (place in the phase), 1 in restitution else 0.
    out = pose error of the fixed soles [m, rad], twist of the fixed soles [m/s, rad/s]; of a freeze, what
        rates and accelerations are off by.
    """
    y0, u0 = ca.SX.sym("y0", c.ny), ca.SX.sym("u0", c.ny)
    legs, rates = ca.SX.sym("legs", c.nl), ca.SX.sym("rates", c.nl)
    T1, T, s, after = (ca.SX.sym(name) for name in ("T1", "T", "s", "after"))
    y = y0 + u0 * (after * T1 + T * s)
    z = [y0, u0, T1, T, legs, rates]
    if frozen is None:
        out = {"closure": c.closure(y, legs), "twist": c.sole_twists(y, legs, u0, rates)}
        return make_block(z, [s, after], out, lanes=4)
    bends = ca.SX.sym("bends", c.nl)
    v, a = (leg_part(c, x) for x in c.motion(y, legs, u0, ca.SX.zeros(c.ny)))
    out = {"closure": c.closure(y, legs), "rate": rates - v, "acceleration": bends - a}
    return make_block([*z, bends], [s, after], out, lanes=2)


def collision(
    c: StanceCoordinates,
    striker: str,
    frozen: Effects | None = None,
    second: str = "",
    chosen: Joints = (),
    rubs: bool = False,
) -> BlockExpression:
    """Equation of motion (6) at one collocation point of the collision.

    H, J and bias are those at the point, anew at each (steps 1a to 4a of the paper); or those that a freeze
    has stored (1b), with its terms. Then accelerations are linear in torques and forces (3b to 5b), and so
    are those of legs and striker in the frozen Jacobians (6b).
    The servo (equation 10; 12 as constraints) follows a reference that coasts at its velocity at contact:
    tau = tau_ff + Kp (phi_ref - phi) + Kd (phidot_ref - phidot).

    z = y0, u0 (ydot) at contact; feed-forward over torque limit (n); d1, T1, d, T: y = y0 + T1 d1 + T d;
        u = ydot; u' (in the phase's s); legs; f [N], with a second striker two; w (6 a sole).
      not frozen: legs and leg rates of the coasting reference.
      frozen: y, ydot and legs of the freeze; rates of the reference's legs when its segment began, their
        acceleration, time [s] since; rates of the legs and their lag behind the reference, each with its
        slope; slope of the hand's speed; wrenches that carry the weight, where the model has no bias (nw).
      last: logarithms of the factors on the gains of ``chosen`` joints.
    p = normal (3), s (place in the phase), 1 in restitution else 0, Kp, Kd, torque limits (n each), weight
        [N], lever [m]; if the striking point ``rubs`` the parameters of `ContactFriction`.
    out = closure [m, rad], base rows, joint rows over torque limit, servo torque over limit; frozen: what the
        slopes of the legs' rates, of their lag and of the hand's speed are off by.
    """
    ny, n, nl, nw = c.ny, c.robot.n, c.nl, 6 * len(c.legs)
    y0, u0, d1, d, u, u1 = (ca.SX.sym(s, ny) for s in ("y0", "u0", "d1", "d", "u", "u1"))
    legs, ff, w = ca.SX.sym("legs", nl), ca.SX.sym("ff", n), ca.SX.sym("w", nw)
    strikers = _strikers(striker, second)
    T1, T, f = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("f", len(strikers))
    normal, s, after = ca.SX.sym("n", 3), ca.SX.sym("s"), ca.SX.sym("after")
    kp, kd, limit = ca.SX.sym("kp", n), ca.SX.sym("kd", n), ca.SX.sym("limit", n)
    weight, lever, logs = ca.SX.sym("weight"), ca.SX.sym("lever"), ca.SX.sym("logs", len(chosen))
    rub = ca.SX.sym("rub", 2 * rubs)
    t = after * T1 + T * s
    y, ydd = ca.SX.sym("y", ny), ca.SX.sym("ydd", ny)
    through = [(y, y0 + T1 * d1 + T * d), (ydd, u1 / T)]
    at, carried, slopes = (y, u, legs), ca.SX.zeros(nw), {}
    if frozen is None:
        lag, slower = (ca.SX.sym(s, nl) for s in ("ref_legs", "ref_rates"))
        more = [lag, slower]
    else:
        of_freeze = ca.SX.sym("yf", ny), ca.SX.sym("uf", ny), ca.SX.sym("legsf", nl)
        of_legs = [ca.SX.sym(s, nl) for s in ("began", "bends", "r", "r1", "lag", "lag1")]
        began, bends, r, r1, lag, lag1 = of_legs
        since, faster = ca.SX.sym("since"), ca.SX.sym("h1")
        at, more = of_freeze, [*of_freeze, *of_legs, since, faster]
        if not frozen.bias:
            carried = ca.SX.sym("carried", nw)
            more.append(carried)
    v, a, stages = _motion(c, *at, ydd, jdot=frozen is None or frozen.jdot)
    q = c.configuration(at[0], at[2])
    tau = _inverse_dynamics(c, q, v, a, bias=frozen is None or frozen.bias)
    for k, name in enumerate(strikers):
        row = ca.Function("row", [c.rb.q], [ca.densify(c.rb.jacobian(f"striker:{name}")[:3, :])])(q)
        way = pushed_way(normal, ca.mtimes(row, v), *ca.vertsplit(rub)) if rubs else normal
        tau += ca.mtimes(row.T, way) * f[k]
    tau -= c.sole_wrench_map(at[0], at[2], w - carried)
    # position and rate of the reference relative to the robot, by joint (the base's part is not the servo's)
    if frozen is None:
        lag, slower = lag - legs, slower - leg_part(c, v)
    else:
        slower = began + bends * since - r
        tip = striker_kinematics(c, striker)(q, v if frozen.jdot else 0 * v, a)[2]
        slopes = {"legs": r1 - T * leg_part(c, a), "lag": lag1 - T * slower}
        slopes["hand"] = faster - T * ca.dot(normal, tip)
    driven = np.ones(ny)
    driven[c.base :] -= c.robot.sprung[c.independent]  # a spring's rest does not move
    ahead = c.configuration(y0 + driven * u0 * t - y, lag)[c.base :]
    stiff, damped = chosen_gains(kp, kd, logs, chosen)
    servo = ff + (stiff * ahead + damped * c.configuration(u0 - u, slower)[c.base :]) / limit
    out = {
        "closure": c.closure(y, legs),
        "base": tau[: c.base, :] / base_scale(c, weight, lever),
        "joints": tau[c.base :] / limit - servo,
        "torque": servo,
        **slopes,
    }
    z = [y0, u0, *more[: 2 * (frozen is None)], ff, d1, T1, d, T, u, u1, legs, f, w]
    z += [*(more if frozen is not None else []), logs]
    p = [normal, s, after, kp, kd, limit, weight, lever, rub]
    return make_block(z, p, out, through, lanes=4, stages=stages)


def _strikers(striker: str, second: str) -> list[str]:
    return [striker, second] if second else [striker]


def _motion(
    c: StanceCoordinates, y: Any, u: Any, legs: Any, ydd: Any, *, jdot: bool = True
) -> tuple[Any, Any, list[Stage]]:
    """v and a (nv) on fixed soles, and their stages; without dJ/dt v, a as if nothing moved."""
    return motion_in_stages(c, y, legs, u, ydd) if jdot else (*(c.velocity(y, legs, x) for x in (u, ydd)), [])


def _inverse_dynamics(c: StanceCoordinates, q: Any, v: Any, a: Any, *, bias: bool = True) -> Any:
    """H a (nv), and Coriolis, centrifugal and gravity forces."""
    rb = c.rb
    if not bias:
        return _inertia(c)(q, a)
    return ca.Function("rnea", [rb.q, rb.v, rb.a], [rb.rnea(rb.v, rb.a)])(q, v, a)


def force(
    c: StanceCoordinates,
    striker: str,
    law: ContactLaw,
    target: Target,
    frozen: Effects | None = None,
    second: str = "",
) -> BlockExpression:
    """Contact law and target at one collocation point (equations 14 to 17, integrated).

    z = y0; d1, T1, d, T, u as in :func:`collision`, or where its dynamics are frozen in place of y0, d1, d
        and u those of the hand along the normal (no y0; 7b); f [N], with a second striker two, whose sum the
        target feels; the target's state and its slope (in s);
        travel x of its surface, x' and x1 as d, u and d1; slope p' of the impulse.
    p = point (3), normal (3), 1 in restitution else 0, the law's parameters, the target's; of a target with
        events before them, of each phase, 1 in it else 0, and how long [s] it has to last; the second point.
    out = (f - law) / 100 N, state' - T d(state)/dt over its typical size, x' - speed [m/s], p' - T f [N s],
        approach speed [m/s], penetration / 1 cm, what is zero at separation / 100 N, speed of the target's
        surface [m/s], what is zero when its phase ends, what is not below zero while it lasts, and when it
        ends; of a second striker: law, approach speed, penetration and what is zero at separation.
    """
    ny, n = c.ny if frozen is None else 1, target.n_states
    y0, d1, d, u = (ca.SX.sym(s, ny) for s in ("y0", "d1", "d", "u"))
    strikers = _strikers(striker, second)
    T1, T, f = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("f", len(strikers))
    total = ca.sum1(f)
    state, slope = ca.SX.sym("state", n), ca.SX.sym("slope", n)
    x, rate_x, x1, rate_p = (ca.SX.sym(s) for s in ("x", "rate_x", "x1", "rate_p"))
    point, normal = ca.SX.sym("point", 3), ca.SX.sym("n", 3)
    other = ca.SX.sym("other", 3 * bool(second))
    restituting, phases = ca.SX.sym("restituting"), range(len(target.phases) if target.guards else 0)
    within, shortest = ca.SX.sym("within", len(phases)), ca.SX.sym("shortest", min(len(phases), 1))
    of_law = ca.SX.sym("law", len(law.parameters))
    of_target = ca.SX.sym("target", len(target.parameters))
    y, gone = ca.SX.sym("y", ny), ca.SX.sym("gone")
    if frozen is None:
        q, vel, _ = c.upper_motion(y, u, ca.SX.zeros(ny))
        hands = []
        for name, at in zip(strikers, (point, other), strict=False):
            place, twist, _ = striker_kinematics(c, name)(q, vel, ca.SX.zeros(c.rb.nv))
            hands.append((ca.dot(normal, place - at), ca.dot(normal, twist)))
    else:
        hands = [(y, u)]
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    numbers = {name: of_target[i] for i, name in enumerate(target.parameters)}
    pieces = [target.smooth(state, total, k, numbers) for k in phases or (0,)]
    speed, moves = ca.SX(pieces[0][0]), ca.vertcat(ca.SX(0, 1), *pieces[0][1])
    event = invariant = reserve = ca.SX(0, 1)

    def of_phase(parts: list[list[Any]]) -> Any:
        return sum((ca.vertcat(ca.SX(0, 1), *part) * within[k] for k, part in enumerate(parts) if part), 0.0)

    if target.guards:
        speed, moves = of_phase([[v] for v, _ in pieces]), of_phase([rates for _, rates in pieces])
        event = of_phase(
            [[target.guard(state, total, T - shortest, k, numbers)] for k in range(len(target.guards))]
        )
        invariant = of_phase([target.invariant(state, total, k, numbers) for k in phases])
        reserve = ca.SX(of_phase([target.reserve(state, total, k, numbers) for k in phases]))
    of_hands = []
    for k, (way, approach) in enumerate(hands):
        penetration, rate = way - gone, approach - speed
        compress, restitute = (law.branch(penetration, rate, flag, named) for flag in (True, False))
        off = (f[k] - ((1 - restituting) * compress + restituting * restitute)) / FORCE_SCALE
        ends = ca.SX(law.separation(penetration, rate, named)) / FORCE_SCALE
        of_hands.append((off, rate, penetration / DEPTH_SCALE, ends))
    off, rate, deep, ends = of_hands[0]
    out = {
        "law": off,
        "target": (slope - T * moves) / np.array(typical_state(target)),
        "travel": rate_x - speed,
        "impulse": rate_p - T * total,
        "rate": rate,
        "penetration": deep,
        "separation": ends,
        "speed": speed,
        "event": event,
        "invariant": invariant,
        "reserve": reserve,
        **(dict(zip(SECOND, of_hands[1], strict=True)) if second else {}),
    }
    z = [*([y0] if frozen is None else []), d1, T1, d, T, u, f, state, slope, x, rate_x, x1, rate_p]
    start = y0 if frozen is None else 0.0
    through = [(y, start + T1 * d1 + T * d), (gone, T1 * x1 + T * x)]
    p = [point, normal, restituting, within, shortest, of_law, of_target, other]
    return make_block(z, p, out, through, lanes=4)


def moved(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Position of the robot in contact, for a new freeze there, and its hand's speed along the normal.

    z = y0, d1, T1, d, T, u as in :func:`collision`;  p = normal (3).  out = y; speed along the normal [m/s].
    """
    y0, d1, d, u, y = (ca.SX.sym(s, c.ny) for s in ("y0", "d1", "d", "u", "y"))
    T1, T, normal = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("n", 3)
    q, v, _ = c.upper_motion(y, u, ca.SX.zeros(c.ny))
    twist = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[1]
    out = {"y": y, "speed": ca.dot(normal, twist)}
    return make_block([y0, d1, T1, d, T, u], [normal], out, [(y, y0 + T1 * d1 + T * d)], lanes=4)


def carried(c: StanceCoordinates) -> BlockExpression:
    """Base load of the soles beside the forces of a model without bias: weight, Coriolis and centrifugal
    forces.

    z = y, legs, u at contact; wrenches (6 a sole);  p = weight [N], lever [m].  out = base rows.
    """
    y, u, legs = ca.SX.sym("y", c.ny), ca.SX.sym("u", c.ny), ca.SX.sym("legs", c.nl)
    w, weight, lever = ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("weight"), ca.SX.sym("lever")
    v = c.velocity(y, legs, u)
    force = _inverse_dynamics(c, c.configuration(y, legs), v, ca.SX.zeros(c.rb.nv)) - c.sole_wrench_map(
        y, legs, w
    )
    out = {"base": force[: c.base, :] / base_scale(c, weight, lever)}
    return make_block([y, legs, u, w], [weight, lever], out, lanes=1)


def typical_state(target: Target) -> tuple[float, ...]:
    """Sizes of the numbers of a target's state."""
    return target.typical or (1.0,) * target.n_states


def impact(c: StanceCoordinates, striker: str) -> BlockExpression:
    """An impact in no time: impulse balance of the robot on its soles, and the law of the impulse.

    z = y; legs; u0 (ydot) at contact; its change; impulsive sole wrenches [N s, N m s]; impulse I [N s].
    p = normal (3); 1 for a given restitution, 0 for that of the contact law; that restitution; stiffness
        [N/m], damping [N s/m] of the law; 1/mass of the target [1/kg], its speed before [m/s]; torque limits
        (n); weight [N]; lever [m].
    out = base rows, joint rows (over torque limit), separation against approach [m/s].
    """
    ny, n = c.ny, c.robot.n
    y, u0, du = (ca.SX.sym(s, ny) for s in ("y", "u0", "du"))
    legs, w, blow = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("I")
    normal, rigid, given = ca.SX.sym("n", 3), ca.SX.sym("rigid"), ca.SX.sym("e")
    stiffness, damping, inverse_mass = ca.SX.sym("k"), ca.SX.sym("d"), ca.SX.sym("im")
    before = ca.SX.sym("before")
    limit, weight, lever = ca.SX.sym("limit", n), ca.SX.sym("weight"), ca.SX.sym("lever")
    q, push = _pushed(c, striker, y, legs, normal)
    change = c.velocity(y, legs, du)
    balance = _inertia(c)(q, change) + push * blow - c.sole_wrench_map(y, legs, w)
    lost = -ca.dot(
        push, change
    )  # speed that the impulse takes from the hand; I over it is the effective mass
    approach = ca.dot(push, c.velocity(y, legs, u0)) - before
    # zeta = d / (2 sqrt(k mu)), with 1/mu = 1/m_a + 1/m_t
    stiff = damping / 2 * ca.sqrt((lost / blow + inverse_mass) / stiffness)
    e = rigid * given + (1 - rigid) * two_mass_restitution(stiff)
    out = {
        # 0.1 s of the limits' forces: impulses of order one
        "base": balance[: c.base, :] / (0.1 * base_scale(c, weight, lever)),
        "joints": balance[c.base :] / (0.1 * limit),
        # the target gains I / m_t, the hand loses I / m_a: what approached with v_c parts with e v_c
        "blow": blow * inverse_mass + lost - (1 + e) * approach,
    }
    p = [normal, rigid, given, stiffness, damping, inverse_mass, before, limit, weight, lever]
    return make_block([y, legs, u0, du, w, blow], p, out, lanes=2)


def first_instant(c: StanceCoordinates, striker: str, law: ContactLaw, rubs: bool = False) -> BlockExpression:
    """The first instant of contact, at which a damped contact has a force already: accelerations jump.

    What changes is linear in the force: H da = J_c' dw - j' f, the frozen part of equation (6).
    z = y, legs, u0 (ydot) at contact; change of ydd; of the sole wrenches (6 a sole); f [N].
    p = normal (3), the law's parameters, the target's speed before [m/s], armature (n), torque limits (n),
        weight [N], lever [m]; if the striking point ``rubs`` the parameters of `ContactFriction`.
    out = base rows, joint rows over torque limit, (f - law) / 100 N, torque that the rotors take off the
        gears, over limit: -armature x acceleration.
    """
    ny, n = c.ny, c.robot.n
    y, u0, change = (ca.SX.sym(s, ny) for s in ("y", "u0", "change"))
    legs, w, f = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("f")
    normal, of_law = ca.SX.sym("n", 3), ca.SX.sym("law", len(law.parameters))
    armature, limit = ca.SX.sym("armature", n), ca.SX.sym("limit", n)
    weight, lever, before = ca.SX.sym("weight"), ca.SX.sym("lever"), ca.SX.sym("before")
    q, push = _pushed(c, striker, y, legs, normal)
    jump = c.velocity(y, legs, change)
    v, a = c.motion(y, legs, u0, ca.SX.zeros(ny))
    rub, way = ca.SX.sym("rub", 2 * rubs), push
    if rubs:
        speed = striker_kinematics(c, striker)(q, v, 0 * v)[1]
        way = _pushed(c, striker, y, legs, pushed_way(normal, speed, *ca.vertsplit(rub)))[1]
    balance = _inertia(c)(q, jump) + way * f - c.sole_wrench_map(y, legs, w)
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    out = {
        "base": balance[: c.base, :] / base_scale(c, weight, lever),
        "joints": balance[c.base :] / limit,
        "law": (f - law.branch(0.0, ca.dot(push, v) - before, True, named)) / FORCE_SCALE,
        "rotors": -armature * (a + jump)[c.base :] / limit,
    }
    z, p = [y, legs, u0, change, w, f], [normal, of_law, before, armature, limit, weight, lever, rub]
    return make_block(z, p, out, lanes=2)


def _inertia(c: StanceCoordinates) -> Any:
    """H a (nv) as a function of q and a."""
    rb = c.rb
    return ca.Function("inertia", [rb.q, rb.a], [rb.rnea(None, rb.a, gravity=False)])


def _pushed(c: StanceCoordinates, striker: str, y: Any, legs: Any, normal: Any) -> tuple[Any, Any]:
    """q, and the row (nv, 1) of the striking point's speed along the normal in the velocities."""
    q = c.configuration(y, legs)
    row = ca.Function("row", [c.rb.q], [ca.densify(c.rb.jacobian(f"striker:{striker}")[:3, :])])(q)
    return q, ca.mtimes(row.T, normal)


def two_mass_restitution(ratio: Any) -> Any:
    """Speed of separation over that of approach of two masses with a spring, and a damper in compression.

    ratio: the damping over the critical one, of the reduced mass: zeta = d / (2 sqrt(k mu)).
    e = exp(-zeta arccos(zeta) / sqrt(1 - zeta^2)), continued through zeta = 1 by its series.
    """
    # Near zeta = 1 both forms are 0/0; the series is right to 3e-10 there. All branches are evaluated, so
    # each gets an argument at which it is finite.
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


def chosen_gains(stiffness: Any, damping: Any, logs: Any, chosen: Joints) -> tuple[Any, Any]:
    """Stiffness times the factors of ``chosen``, whose logarithms are ``logs``; damping times their roots."""
    stiffness, damping = ca.SX(stiffness), ca.SX(damping)
    for k, joints in enumerate(chosen):
        for joint in joints:
            stiffness[joint] *= ca.exp(logs[k])
            damping[joint] *= ca.exp(logs[k] / 2)  # the damping ratio stays
    return stiffness, damping
