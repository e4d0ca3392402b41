"""Nonlinear functions of a contact as CasADi expressions of variables z and parameters p: see `blocks`.

All collision models share them: a frozen model evaluates the rigid-body functions at a state of its own, the
freeze. Numbers of steps and equations are the paper's.

The position in a phase is y = y0 + T1 d1 + T d: y0 at contact, T1 the time of all phases before, d1 the mean
rate in it, T the duration of the phase, d the integral of the rate u = ydot over s. A prime is d/ds.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from impactopt.collision.settings import Effects
from impactopt.contact.friction import deflection_rate, lean, pushed_way
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import Target
from impactopt.kinematics.coordinates import StanceCoordinates, striker_kinematics
from impactopt.kinematics.stages import Stage, motion_in_stages
from impactopt.problem.block import BlockExpression, make_block

FORCE_SCALE = 100.0  # [N] of contact forces, and of their constraints
DEPTH_SCALE = 0.01  # [m] of the constraints of penetration
SECOND = ("second law", "second rate", "second penetration", "second separation")  # outputs of `force`
RESTITUTING = 6  # index of the parameter of `force` that is 1 in restitution, else 0
JointGroups = tuple[tuple[int, ...], ...]  # joints (indices of the gains) that share one gain factor each


def base_scale(c: StanceCoordinates, weight: Any, lever: Any) -> Any:
    """Scale of the base's equations: the weight [N], and for moments the weight times the lever [m]."""
    return ca.vertcat(*[weight] * 3, *[weight * lever] * 3) if c.base else ca.SX(0, 1)


def leg_part(c: StanceCoordinates, v: Any) -> Any:
    """Entries of the constrained legs' joints (nl,) of a vector (nv,)."""
    return ca.vertcat(*[v[c.base + int(j)] for j in c.dependent])


def coasting(c: StanceCoordinates, frozen: Effects | None = None) -> BlockExpression:
    """Legs of the reference that coasts through the collision: residuals of soles in place and at rest.

    z = y0; u0 (ydot at contact); T1; T; legs; leg rates [rad/s]; frozen: leg accelerations [rad/s^2].
    p = s (place in the phase).
    out = pose error of the fixed soles [m, rad]; their twist [m/s, rad/s]. Frozen: in place of the twist,
        residuals of rates and accelerations.
    """
    y0, u0 = ca.SX.sym("y0", c.ny), ca.SX.sym("u0", c.ny)
    legs, rates = ca.SX.sym("legs", c.nl), ca.SX.sym("rates", c.nl)
    T1, T, s = (ca.SX.sym(name) for name in ("T1", "T", "s"))
    # the reference coasts: constant rates of y, whatever the robot does
    y = y0 + u0 * (T1 + T * s)
    z = [y0, u0, T1, T, legs, rates]
    if frozen is None:
        out = {"closure": c.closure(y, legs), "twist": c.sole_twists(y, legs, u0, rates)}
        return make_block(z, [s], out, lanes=4)
    accelerations = ca.SX.sym("accelerations", c.nl)
    # no yddot: leg joints accelerate only as far as constant rates of y need it
    v, a = (leg_part(c, x) for x in c.motion(y, legs, u0, ca.SX.zeros(c.ny)))
    out = {"closure": c.closure(y, legs), "rate": rates - v, "acceleration": accelerations - a}
    return make_block([*z, accelerations], [s], out, lanes=2)


def collision(
    c: StanceCoordinates,
    striker: str,
    frozen: Effects | None = None,
    second: str = "",
    gain_groups: JointGroups = (),
    friction: int = 0,
    moves_target: bool = False,
) -> BlockExpression:
    """Equation of motion (6) at one collocation point of the collision.

    H, J and bias are those at the point (steps 1a to 4a of the paper). In a frozen model they are those of a
    freeze (1b), so accelerations are linear in torques and forces (3b to 5b), and so are those of legs and
    striker by the frozen Jacobians (6b).
    The servo (equation 10; 12 as constraints) follows a reference that coasts at its velocity at contact:
    tau = tau_ff + Kp (phi_ref - phi) + Kd (phidot_ref - phidot).

    frozen : terms of the frozen model; None: full dynamics.  second : another striker.
    gain_groups : joints whose gains have a factor each.  friction : number of its parameters; 3 with
        bristles.  moves_target : it moves the target across the normal.

    z = y0; u0 (ydot at contact);
        not frozen: legs and leg rates of the coasting reference;
        feed-forward over torque limit (n,); d1; T1; d; T; u (ydot); u'; legs; f [N], one a striker; w (6 a
        sole);
        bristles: deflections z [m], z', three a striker;
        moves_target: velocity of the target across the normal (3,) [m/s], and its slope;
        frozen: y, ydot and legs of the freeze; rates of the reference's legs at the beginning of the segment,
        their accelerations at the freeze; rates r of the legs, r'; lag of the legs behind the reference,
        lag'; time [s] since the beginning of the segment; slope of the hand's speed; without bias, wrenches
        that carry the weight (nw,); logarithms of the gain factors.
    p = normal (3,); s (place in the phase); Kp, Kd, torque limits (n, each); weight [N]; lever [m]; with
        friction the parameters of `ContactFriction`; with moves_target the target's mobility [1/kg].
    out = closure [m, rad]; base equations over weight and weight x lever; joint equations over torque limit;
        servo torque over limit; residuals of z' over 1 cm; of the target's tangential velocity;
        frozen: residuals of r', of lag' and of the slope of the hand's speed.
    """
    ny, n, nl, nw = c.ny, c.robot.n, c.nl, 6 * len(c.legs)
    y0, u0, d1, d, u, u1 = (ca.SX.sym(s, ny) for s in ("y0", "u0", "d1", "d", "u", "u1"))
    legs, ff, w = ca.SX.sym("legs", nl), ca.SX.sym("ff", n), ca.SX.sym("w", nw)
    strikers = _strikers(striker, second)
    T1, T, f = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("f", len(strikers))
    normal, s = ca.SX.sym("n", 3), ca.SX.sym("s")
    kp, kd, limit = ca.SX.sym("kp", n), ca.SX.sym("kd", n), ca.SX.sym("limit", n)
    weight, lever, logs = ca.SX.sym("weight"), ca.SX.sym("lever"), ca.SX.sym("logs", len(gain_groups))
    of_friction = ca.SX.sym("friction", friction)
    bent, bent1 = (ca.SX.sym(s, 3 * len(strikers) * (friction > 2)) for s in ("bent", "bent1"))
    side, side1 = (ca.SX.sym(s, 3 * moves_target) for s in ("tangential", "tangential1"))
    mobility = ca.SX.sym("mobility", int(moves_target))
    t = T1 + T * s  # since contact
    y, ydd = ca.SX.sym("y", ny), ca.SX.sym("ydd", ny)
    through = [(y, y0 + T1 * d1 + T * d), (ydd, u1 / T)]
    # at: state at which the rigid-body functions are evaluated
    at, carried, slopes = (y, u, legs), ca.SX.zeros(nw), {}
    if frozen is None:
        ref_legs, ref_rates = (ca.SX.sym(s, nl) for s in ("ref_legs", "ref_rates"))
        own = [ref_legs, ref_rates]
    else:
        of_freeze = ca.SX.sym("yf", ny), ca.SX.sym("uf", ny), ca.SX.sym("legsf", nl)
        names = ("ref_rates0", "ref_accelerations", "r", "r1", "lag", "lag1")
        ref_rates0, ref_accelerations, r, r1, lag, lag1 = of_legs = [ca.SX.sym(s, nl) for s in names]
        since, hand_slope = ca.SX.sym("since"), ca.SX.sym("h1")
        at, own = of_freeze, [*of_freeze, *of_legs, since, hand_slope]
        if not frozen.bias:
            carried = ca.SX.sym("carried", nw)
            own.append(carried)
    v, a, stages = _motion(c, *at, ydd, jdot=frozen is None or frozen.jdot)
    q = c.configuration(at[0], at[2])
    # equation (6): H a + bias + j' f - J_c' w = S' tau
    tau = _inverse_dynamics(c, q, v, a, bias=frozen is None or frozen.bias)
    bristles, push = ca.SX(0, 1), ca.SX.zeros(3)  # residuals of z'; friction on the target
    for k, name in enumerate(strikers):
        J, way = _striker_jacobian(c, name, q), normal
        slide = ca.mtimes(J, v) - side if moves_target else ca.mtimes(J, v)
        if friction > 2:
            mu, slip_speed, bristle_stiffness = ca.vertsplit(of_friction)
            z, z1 = bent[3 * k : 3 * k + 3], bent1[3 * k : 3 * k + 3]
            leaning = lean(z, f[k], mu, bristle_stiffness)
            way = normal + mu * leaning
            slope = T * deflection_rate(normal, slide, leaning, slip_speed)
            bristles = ca.vertcat(bristles, (z1 - slope) / DEPTH_SCALE)
        elif friction:
            way = pushed_way(normal, slide, *ca.vertsplit(of_friction))
        tau += ca.mtimes(J.T, way) * f[k]
        push += (way - normal) * f[k]
    # Without bias H a has no weight, so the part of w that carries it must not stand in the balance either.
    tau -= c.sole_wrench_map(at[0], at[2], w - carried)
    # Reference minus robot: angles and rates of the constrained legs' joints, ...
    if frozen is None:
        lag, rate_lag = ref_legs - legs, ref_rates - leg_part(c, v)
    else:
        rate_lag = ref_rates0 + ref_accelerations * since - r
        # v enters this acceleration as dJ/dt v alone: without it, equation (15) in place of (14)
        hand_acceleration = striker_kinematics(c, striker)(q, v if frozen.jdot else 0 * v, a)[2]
        # a prime is d/ds, and t = T s in the phase: r' = T dr/dt
        slopes = {"legs": r1 - T * leg_part(c, a), "lag": lag1 - T * rate_lag}
        slopes["hand"] = hand_slope - T * ca.dot(normal, hand_acceleration)
    # ... and of all others. The reference of a sprung joint is its angle at rest, which does not coast.
    coasts = np.ones(ny)
    coasts[c.base :] -= c.robot.sprung[c.independent]
    # `configuration` puts parts of y and of the legs in the robot's order of joints; the base's part is cut
    # off.
    angle_error = c.configuration(y0 + coasts * u0 * t - y, lag)[c.base :]
    rate_error = c.configuration(u0 - u, rate_lag)[c.base :]
    stiffness, damping = with_gain_factors(kp, kd, logs, gain_groups)
    # equation (10), over the torque limit
    servo = ff + (stiffness * angle_error + damping * rate_error) / limit
    out = {
        "closure": c.closure(y, legs),
        "base": tau[: c.base, :] / base_scale(c, weight, lever),
        # what the motion needs, less what the servo gives: the limit (12) itself is a bound of "torque"
        "joints": tau[c.base :] / limit - servo,
        "torque": servo,
        "bristles": bristles,
        "tangential": side1 - T * mobility * push if moves_target else ca.SX(0, 1),
        **slopes,
    }
    z = [y0, u0, *(own if frozen is None else []), ff, d1, T1, d, T, u, u1, legs, f, w]
    z += [bent, bent1, side, side1]
    z += [*(own if frozen is not None else []), logs]
    p = [normal, s, kp, kd, limit, weight, lever, of_friction, mobility]
    return make_block(z, p, out, through, lanes=4, stages=stages)


def _strikers(striker: str, second: str) -> list[str]:
    """Names of the one or two strikers; ``second`` is "" if there is one."""
    return [striker, second] if second else [striker]


def _striker_jacobian(c: StanceCoordinates, striker: str, q: Any) -> Any:
    """Jacobian (3, nv) of the striking point's velocity, world axes."""
    return ca.Function("row", [c.rb.q], [ca.densify(c.rb.jacobian(f"striker:{striker}")[:3, :])])(q)


def _motion(
    c: StanceCoordinates, y: Any, u: Any, legs: Any, ydd: Any, *, jdot: bool = True
) -> tuple[Any, Any, list[Stage]]:
    """v and a (nv,) on fixed soles, and their stages.  jdot : a has the term dJ/dt v."""
    return motion_in_stages(c, y, legs, u, ydd) if jdot else (*(c.velocity(y, legs, x) for x in (u, ydd)), [])


def _inverse_dynamics(c: StanceCoordinates, q: Any, v: Any, a: Any, *, bias: bool = True) -> Any:
    """H a (nv,), with bias plus Coriolis, centrifugal and gravity forces."""
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

    z = y0; d1; T1; d; T; u. Frozen: no y0, and d1, d, u of the hand along the normal (step 7b);
        f [N], one a striker: the target feels their sum; the target's state, state';
        x, x', x1 of the target's surface, as d, d', d1 of the robot; slope p' of the impulse.
    p = point (3,); normal (3,); 1 in restitution else 0; of a target with events, for each phase 1 in it else
        0, and its least duration [s]; parameters of the law; of the target; the second striker's point.
    out = law: (f - law) / 100 N; target: state' - T d(state)/dt over its typical size; travel: x' - speed
        [m/s]; impulse: p' - T f [N s]; rate of the penetration [m/s]; penetration / 1 cm; separation: zero
        where contact ends, over 100 N; speed of the target's surface [m/s];
        event, invariant, reserve: `Target.guard`, `Target.invariant` and `Target.reserve` of the phase;
        of a second striker its law, rate, penetration and separation.
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
    y, surface = ca.SX.sym("y", ny), ca.SX.sym("surface")
    if frozen is None:
        # right as long as no leg of the stance moves the striker
        q, vel, _ = c.upper_motion(y, u, ca.SX.zeros(ny))
        hands = []  # position and speed along the normal
        for name, at in zip(strikers, (point, other), strict=False):
            place, twist, _ = striker_kinematics(c, name)(q, vel, ca.SX.zeros(c.rb.nv))
            hands.append((ca.dot(normal, place - at), ca.dot(normal, twist)))
    else:
        hands = [(y, u)]
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    parameters = {name: of_target[i] for i, name in enumerate(target.parameters)}
    # a target without events has one smooth mode, in all phases
    modes = [target.smooth(state, total, k, parameters) for k in phases or (0,)]
    speed, derivative = ca.SX(modes[0][0]), ca.vertcat(ca.SX(0, 1), *modes[0][1])
    event = invariant = reserve = ca.SX(0, 1)

    def of_phase(parts: list[list[Any]]) -> Any:
        """The part of the phase that the point is in: all are evaluated, as `within` is a parameter."""
        return sum((ca.vertcat(ca.SX(0, 1), *part) * within[k] for k, part in enumerate(parts) if part), 0.0)

    if target.guards:
        # guards take the time by which a phase lasts longer than its least duration
        speed, derivative = of_phase([[v] for v, _ in modes]), of_phase([rates for _, rates in modes])
        event = of_phase(
            [[target.guard(state, total, T - shortest, k, parameters)] for k in range(len(target.guards))]
        )
        invariant = of_phase([target.invariant(state, total, k, parameters) for k in phases])
        reserve = ca.SX(of_phase([target.reserve(state, total, k, parameters) for k in phases]))
    of_hands = []  # residual of the law, rate, penetration and separation of each striker
    # f_r of equation (17) by one branch of the law, from positions and velocities along the normal
    for k, (position, velocity) in enumerate(hands):
        penetration, rate = position - surface, velocity - speed
        compress, restitute = (law.branch(penetration, rate, flag, named) for flag in (True, False))
        # The branch is a parameter, not a switch: the program stays smooth, and events are at the ends of
        # phases.
        residual = (f[k] - ((1 - restituting) * compress + restituting * restitute)) / FORCE_SCALE
        separation = ca.SX(law.separation(penetration, rate, named)) / FORCE_SCALE
        of_hands.append((residual, rate, penetration / DEPTH_SCALE, separation))
    residual, rate, depth, separation = of_hands[0]
    out = {
        "law": residual,
        "target": (slope - T * derivative) / np.array(target.typical_state),
        "travel": rate_x - speed,
        "impulse": rate_p - T * total,
        "rate": rate,
        "penetration": depth,
        "separation": separation,
        "speed": speed,
        "event": event,
        "invariant": invariant,
        "reserve": reserve,
        **(dict(zip(SECOND, of_hands[1], strict=True)) if second else {}),
    }
    z = [*([y0] if frozen is None else []), d1, T1, d, T, u, f, state, slope, x, rate_x, x1, rate_p]
    start = y0 if frozen is None else 0.0
    through = [(y, start + T1 * d1 + T * d), (surface, T1 * x1 + T * x)]
    p = [point, normal, restituting, within, shortest, of_law, of_target, other]
    return make_block(z, p, out, through, lanes=4)


def moved(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Position of the robot during contact, for a freeze there, and its hand's speed along the normal.

    z = y0; d1; T1; d; T; u.  p = normal (3,).
    out = y; speed along the normal [m/s].
    """
    y0, d1, d, u, y = (ca.SX.sym(s, c.ny) for s in ("y0", "d1", "d", "u", "y"))
    T1, T, normal = ca.SX.sym("T1"), ca.SX.sym("T"), ca.SX.sym("n", 3)
    q, v, _ = c.upper_motion(y, u, ca.SX.zeros(c.ny))
    twist = striker_kinematics(c, striker)(q, v, ca.SX.zeros(c.rb.nv))[1]
    out = {"y": y, "speed": ca.dot(normal, twist)}
    return make_block([y0, d1, T1, d, T, u], [normal], out, [(y, y0 + T1 * d1 + T * d)], lanes=4)


def carried(c: StanceCoordinates) -> BlockExpression:
    """Base equations of the sole wrenches that carry the weight and the Coriolis and centrifugal forces.

    A model without bias has the other forces only.

    z = y, legs, u (ydot) at contact; wrenches (6 a sole).  p = weight [N]; lever [m].
    out = base equations over weight and weight x lever.
    """
    y, u, legs = ca.SX.sym("y", c.ny), ca.SX.sym("u", c.ny), ca.SX.sym("legs", c.nl)
    w, weight, lever = ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("weight"), ca.SX.sym("lever")
    v = c.velocity(y, legs, u)
    # bias alone: gravity, Coriolis and centrifugal forces, as a = 0
    force = _inverse_dynamics(c, c.configuration(y, legs), v, ca.SX.zeros(c.rb.nv))
    force -= c.sole_wrench_map(y, legs, w)
    out = {"base": force[: c.base, :] / base_scale(c, weight, lever)}
    return make_block([y, legs, u, w], [weight, lever], out, lanes=1)


def impact(c: StanceCoordinates, striker: str) -> BlockExpression:
    """Impact without duration: impulse balance of the robot on its soles, and the law of the impulse.

    z = y; legs; u0 (ydot) before; its change du; impulsive sole wrenches [N s, N m s]; impulse I [N s].
    p = normal (3,); 1 for a given restitution, 0 for that of the contact law; the given restitution;
        stiffness [N/m] and damping [N s/m] of the law; 1/mass of the target [1/kg]; its speed before [m/s];
        torque limits (n,); weight [N]; lever [m].
    out = base equations over 0.1 s of weight and weight x lever; joint equations over 0.1 s of the torque
        limit; residual of the speed of separation [m/s].
    """
    ny, n = c.ny, c.robot.n
    y, u0, du = (ca.SX.sym(s, ny) for s in ("y", "u0", "du"))
    legs, w, impulse = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("I")
    normal, rigid, given = ca.SX.sym("n", 3), ca.SX.sym("rigid"), ca.SX.sym("e")
    stiffness, damping, inverse_mass = ca.SX.sym("k"), ca.SX.sym("d"), ca.SX.sym("im")
    before = ca.SX.sym("before")
    limit, weight, lever = ca.SX.sym("limit", n), ca.SX.sym("weight"), ca.SX.sym("lever")
    q = c.configuration(y, legs)
    j = ca.mtimes(_striker_jacobian(c, striker, q).T, normal)  # (nv, 1)
    change = c.velocity(y, legs, du)
    # H N du = -j' I + J_c' w, joints without torque
    balance = _inertia(c)(q, change) + j * impulse - c.sole_wrench_map(y, legs, w)
    lost = -ca.dot(j, change)  # speed of the hand that the impulse takes: I / m_a
    approach = ca.dot(j, c.velocity(y, legs, u0)) - before
    # zeta = d / (2 sqrt(k mu)), with 1/mu = 1/m_a + 1/m_t. Where an iterate's du speeds the hand up, 1/m_a is
    # below zero, and its root would be nan: of a given restitution, too, as 0 nan is nan.
    inverse_reduced_mass = ca.fmax(lost / impulse + inverse_mass, 1e-9)
    damping_ratio = damping / 2 * ca.sqrt(inverse_reduced_mass / stiffness)
    e = rigid * given + (1 - rigid) * two_mass_restitution(damping_ratio)
    out = {
        # over what the limits' forces give in 0.1 s, so that impulses are of order one
        "base": balance[: c.base, :] / (0.1 * base_scale(c, weight, lever)),
        "joints": balance[c.base :] / (0.1 * limit),
        # The target gains I / m_t and the hand loses I / m_a: from approach at v_c to separation at e v_c.
        "blow": impulse * inverse_mass + lost - (1 + e) * approach,
    }
    p = [normal, rigid, given, stiffness, damping, inverse_mass, before, limit, weight, lever]
    return make_block([y, legs, u0, du, w, impulse], p, out, lanes=2)


def first_instant(c: StanceCoordinates, striker: str, law: ContactLaw, friction: int = 0) -> BlockExpression:
    """First instant of contact: a damped contact has a force at once, so accelerations jump.

    The jump is linear in the force: H da = J_c' dw - j' f, the frozen part of equation (6).

    friction : number of its parameters; 3 with bristles, which are not bent yet: there is no friction.

    z = y, legs, u0 (ydot) at contact; change of yddot; of the sole wrenches (6 a sole); f [N].
    p = normal (3,); parameters of the law; the target's speed before [m/s]; armature (n,); torque limits
        (n,); weight [N]; lever [m]; with friction the parameters of `ContactFriction`.
    out = base equations over weight and weight x lever; joint equations over torque limit; (f - law) / 100 N;
        -armature x acceleration over torque limit: the torque that rotors take from the gears' load.
    """
    ny, n = c.ny, c.robot.n
    y, u0, change = (ca.SX.sym(s, ny) for s in ("y", "u0", "change"))
    legs, w, f = ca.SX.sym("legs", c.nl), ca.SX.sym("w", 6 * len(c.legs)), ca.SX.sym("f")
    normal, of_law = ca.SX.sym("n", 3), ca.SX.sym("law", len(law.parameters))
    armature, limit = ca.SX.sym("armature", n), ca.SX.sym("limit", n)
    weight, lever, before = ca.SX.sym("weight"), ca.SX.sym("lever"), ca.SX.sym("before")
    q = c.configuration(y, legs)
    J = _striker_jacobian(c, striker, q)
    da = c.velocity(y, legs, change)
    # acceleration just before contact, where the swing ends with yddot = 0
    v, a = c.motion(y, legs, u0, ca.SX.zeros(ny))
    j = push = ca.mtimes(J.T, normal)  # (nv, 1)
    of_friction = ca.SX.sym("friction", friction)
    if friction == 2:
        speed = striker_kinematics(c, striker)(q, v, 0 * v)[1]
        push = ca.mtimes(J.T, pushed_way(normal, speed, *ca.vertsplit(of_friction)))
    balance = _inertia(c)(q, da) + push * f - c.sole_wrench_map(y, legs, w)
    named = {name: of_law[i] for i, name in enumerate(law.parameters)}
    out = {
        "base": balance[: c.base, :] / base_scale(c, weight, lever),
        "joints": balance[c.base :] / limit,
        "law": (f - law.branch(0.0, ca.dot(j, v) - before, True, named)) / FORCE_SCALE,
        "rotors": -armature * (a + da)[c.base :] / limit,
    }
    p = [normal, of_law, before, armature, limit, weight, lever, of_friction]
    return make_block([y, legs, u0, change, w, f], p, out, lanes=2)


def _inertia(c: StanceCoordinates) -> Any:
    """Function (q, a) -> H a (nv,)."""
    rb = c.rb
    return ca.Function("inertia", [rb.q, rb.a], [rb.rnea(None, rb.a, gravity=False)])


def two_mass_restitution(ratio: Any) -> Any:
    """Coefficient of restitution of two masses with a spring between them, and a damper in compression.

    ratio : damping over critical damping, zeta = d / (2 sqrt(k mu)), of the reduced mass mu.

    e = exp(-zeta arccos(zeta) / sqrt(1 - zeta^2)), continued through zeta = 1 by its series.
    """
    # Near zeta = 1 both forms are 0/0, and the series is accurate to 3e-10. All branches are evaluated, so
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
    """Mean rate d of one coordinate over two phases: out = T1 d1 + T2 d2 - (T1 + T2) d.

    z = T1, T2 (durations [s]); d1, d2 (mean rates in them); d.
    """
    T1, T2, d1, d2, d = z = [ca.SX.sym(s) for s in ("T1", "T2", "d1", "d2", "d")]
    return make_block(list(z), [], {"travel": T1 * d1 + T2 * d2 - (T1 + T2) * d})


def with_gain_factors(stiffness: Any, damping: Any, logs: Any, groups: JointGroups) -> tuple[Any, Any]:
    """Servo stiffness times the factor of each joint group, and damping times its root.

    logs (groups,) : logarithms of the factors.
    """
    stiffness, damping = ca.SX(stiffness), ca.SX(damping)
    for k, joints in enumerate(groups):
        for joint in joints:
            stiffness[joint] *= ca.exp(logs[k])
            damping[joint] *= ca.exp(logs[k] / 2)  # keeps the damping ratio
    return stiffness, damping
