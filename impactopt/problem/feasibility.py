"""Feasibility checks without a solve: valid problems for which no plan can exist."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
from scipy.optimize import linprog

from impactopt.arrays import Array
from impactopt.bodies.clearance import Places, Touch
from impactopt.contact.targets import Nail
from impactopt.errors import InputError, counted
from impactopt.kinematics.inverse_kinematics import Reach, inverse_kinematics, reach
from impactopt.kinematics.operational_space import striking_point
from impactopt.kinematics.stance import support_polygon
from impactopt.problem.plausibility import giant_soles
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import random_postures
from impactopt.problem.terms import (
    DEFAULT_TERMS,
    Balance,
    ContactWrenchCone,
    GroundForce,
    LegExtension,
    TorqueLimit,
)
from impactopt.problem.terms.first_touch import face_of
from impactopt.robots.loads import weight_of

# [m] Distance outside the support polygon to which a motion may take the centre of mass for a short time.
MAX_LEAN = 0.05
AHEAD = 2e-3  # [m] that a link may stick out beyond its striking point without a warning
REACHED = 0.005  # [m] distance from the hit point of a posture that reaches it
_ROUNDING = 1e-6  # of a torque limit, by the linear program
PAST = 1e-3  # [m] beyond the target's plane, for rounded numbers in a problem file
LONG = 10.0  # [s] of a phase: longer ones are hard to believe
HEAVY = 20.0  # mass of a target over the robot's, likewise
HEAVY_NAIL = 1.0  # [kg]: a heavier one is hard to believe
SOFT_WOOD = 1.0  # [N]: a smaller resistance is hard to believe
DRAWN_POSTURES = 3  # initial guesses of inverse kinematics, beside the postures at start and at contact
# initial guesses of random postures at the hit point, and postures found from which it may count as blocked
DRAWN_AT_HIT, LEAST_AT_HIT = 24, 4
BLOCKED_DEPTH = 0.01  # [m] of penetration in all postures at the hit point, above which it counts as blocked


def hopeless(problem: ImpactProblem) -> list[str]:
    """Reasons why no solve can succeed: implausibly large soles; else a start beyond the target, a hit point
    that no balanced posture reaches, and soles that must bear more than the robot's weight.
    """
    found = list(giant_soles(problem.robot))
    found = found or [_beyond(problem), _out_of_balance(problem), _too_light(problem)]
    return [text for text in found if text]


def _too_light(problem: ImpactProblem) -> str:
    """Message if the soles' least forces exceed the weight, which is all that they bear on average from start
    to rest; else "".
    """
    soles, least = len(problem.coordinates.legs), problem.term(ContactWrenchCone).minimum_force
    weight = weight_of(problem.robot)
    # Hands and a target above may press it down; soles may bear more before a step, and less in it.
    pressed = problem.stance.held_hands(problem.robot) or problem.normal[2] > 0
    if pressed or problem.stances or soles * least <= weight:
        return ""
    return (
        f"the robot is too light: [terms.contact_wrench_cone] minimum_force_N asks {least:g} N of each of "
        f"{counted(soles, 'sole')}, and it weighs {weight:.3g} N; give less than {weight / soles:.3g} N"
    )


def _beyond(problem: ImpactProblem) -> str:
    """Message about a start posture whose striking point is beyond the target's plane; else ""."""
    at = striking_point(problem.robot, problem.striker, problem.start_posture)
    past = float(problem.normal @ (at - problem.point))
    if past <= PAST:
        return ""
    return (
        f"the motion starts beyond the target: the start posture has {problem.striker!r} at "
        f"{np.round(at, 3).tolist()} m, {1e3 * past:.0f} mm past the target's plane along the normal; start "
        "from a posture behind it, move the point further along the normal, or turn the normal round"
    )


def too_weak(problem: ImpactProblem) -> str:
    """Message if no wrenches on the constrained frames let the torques hold the robot at rest in its start
    posture; else "". A motion that falls from there at once may be feasible all the same.
    """
    robot, limit = problem.robot, problem.term(TorqueLimit).fraction
    c, q = problem.stance_coordinates[0], problem.start_posture
    weight = robot.generalized_gravity(robot.model.createData(), q)
    # torques are weight - fixed @ wrenches
    fixed = c.sole_jacobians(q)[0].T if c.legs else np.zeros((robot.nv, 0))
    base = robot.nv - robot.n
    driven = np.flatnonzero(~(robot.passive | robot.hinges))
    indices, most = base + driven, robot.torque_limit[driven]
    # linear program in the wrenches w and s: least s with |weight - fixed @ w| / most <= s
    per_wrench = fixed[indices] / most[:, None]
    load = weight[indices] / most
    ones = np.ones((len(indices), 1))
    found = linprog(
        np.append(np.zeros(fixed.shape[1]), 1.0),
        A_ub=np.vstack([np.hstack([-per_wrench, -ones]), np.hstack([per_wrench, -ones])]),
        b_ub=np.concatenate([-load, load]),
        A_eq=np.hstack([fixed[c.undriven], np.zeros((len(c.undriven), 1))]) if len(c.undriven) else None,
        b_eq=weight[c.undriven] if len(c.undriven) else None,
        bounds=(None, None),
    )
    if found.status != 0 or found.fun <= limit + _ROUNDING:
        return ""
    ratios = np.abs(load - per_wrench @ found.x[:-1])
    joint = robot.joint_names[int(driven[int(ratios.argmax())])]
    return (
        f"the torque limits do not hold the robot's own weight: at rest at its start {joint} needs "
        f"{ratios.max():.3g} of its limit, and [terms.torque_limit] fraction allows {limit:.3g}; "
        "raise the limits or the fraction, or start from another posture"
    )


def sticks_out(problem: ImpactProblem) -> list[str]:
    """Messages about strikers whose link sticks out beyond the striking point, and so touches first."""
    faces = {striker: face_of(problem, striker) for striker in problem.strikers}
    return [
        f"the link of the striker {striker!r} sticks out {1e3 * face.ahead:.0f} mm beyond it, and touches "
        "first: contact begins earlier than planned; move the striking point to the link's outermost part"
        for striker, face in faces.items()
        if face is not None and face.ahead > AHEAD
    ]


def overlapping(problem: ImpactProblem) -> str:
    """Message about links, no neighbours, that touch at the start and so need no clearance; else ""."""
    pairs = problem.bodies.overlaps if problem.self_collision.enabled else []
    if not pairs:
        return ""
    named = [f"{one!r} and {other!r}" for one, other in pairs[:3]]
    more = [f"{counted(len(pairs) - 3, 'more pair')}"] if len(pairs) > 3 else []
    return (
        f"links touch in the start posture, and may penetrate each other in the motion: "
        f"{', '.join(named + more)}; start from another posture, or name them in disable_collisions"
    )


def unusual(problem: ImpactProblem) -> list[str]:
    """Messages about numbers that look as if they were in another unit."""
    phases = {"swing": problem.swing, "follow": problem.follow}
    found = [
        f"[{name}] duration_s is at least {phase.duration[0]:g}: an impact's motion takes about a second; is "
        "it in milliseconds?"
        for name, phase in phases.items()
        if phase.duration[0] > LONG
    ]
    mass, robot = getattr(problem.target, "mass", np.inf), pin.computeTotalMass(problem.robot.model)
    if HEAVY * robot < mass < np.inf:
        found.append(
            f"[target] mass_kg: {mass:g} kg is {mass / robot:.0f} times the robot's mass; is it in grams?"
        )
    elif isinstance(problem.target, Nail) and mass > HEAVY_NAIL:
        found.append(f"[target] mass_kg: {mass:g} kg is much for a nail; is it in grams?")
    if isinstance(problem.target, Nail) and problem.target.resistance < SOFT_WOOD:
        found.append(f"[target] resistance_N: {problem.target.resistance:g} N is no wood's; is it in kN?")
    return found


def without_effect(problem: ImpactProblem) -> list[str]:
    """Messages about tolerances of a collision model that is not chosen, and about terms that bound nothing,
    as the robot stands on no soles.
    """
    out = [
        f'[collision] {name} has no effect: it is of model = "auto"'
        for name in ("auto_impulse_pct", "auto_zmp_mm")
        if problem.collision != "auto" and getattr(problem, name) != getattr(type(problem), name)
    ]
    kinds = (Balance, ContactWrenchCone, GroundForce, LegExtension)
    given = [term for term in problem.terms if isinstance(term, kinds) and term not in DEFAULT_TERMS]
    return out + [
        f"[terms.{term.section}] has no effect: it is of soles on the ground, and none stands there"
        for term in given
        if not problem.soles and getattr(term, "enabled", True)
    ]


def _out_of_balance(problem: ImpactProblem) -> str:
    """Message about a hit point that no posture reaches with the centre of mass above the soles; else ""."""
    c = problem.coordinates
    polygon = support_polygon(problem.robot, c)
    if not len(polygon):
        return ""
    found = _nearest(problem, polygon)
    if found.off <= REACHED:
        return ""
    names = ", ".join(sole.name for sole in c.soles)
    return (
        f"the point {np.round(problem.point, 3).tolist()} m is out of balance's reach: the best posture "
        f"found is {1e3 * found.off:.0f} mm off it with the centre of mass "
        f"{1e3 * max(found.outside, 0):.0f} mm outside the support polygon of {names}; move the point nearer "
        "to the feet"
    )


def _nearest(problem: ImpactProblem, polygon: Array) -> Reach:
    """Balanced posture with the striking point nearest to the hit point, from several initial guesses."""
    c, robot = problem.coordinates, problem.robot
    fixed = [(leg.frame, leg.placement) for leg in c.legs]
    rng = np.random.default_rng(0)
    guesses = [problem.contact_posture, problem.start_posture]
    for _ in range(DRAWN_POSTURES):
        step = np.concatenate([np.zeros(robot.nv - robot.n), 0.3 * rng.standard_normal(robot.n)])
        guesses.append(pin.integrate(robot.model, problem.start_posture, step))
    best = None
    for guess in guesses:
        found = reach(robot, fixed, polygon, problem.striker, problem.point, guess, lean=MAX_LEAN)
        best = found if best is None or found.off < best.off else best
        if best.off <= REACHED:
            break
    assert best is not None
    return best


def blocked(problem: ImpactProblem) -> list[str]:
    """Message about a hit point where bodies penetrate deeply in all of several postures found, if any.

    There may be others, so that a motion may be found all the same.
    """
    if problem.second is not None or not (problem.keep_out.enabled and problem.self_collision.enabled):
        return []
    try:
        bodies = problem.bodies
    except InputError:  # of the start posture, which a solve refuses
        return []
    found = list[Touch]()
    for q in _postures_at_hit(problem):
        at = Places.of(problem.robot, q[None], np.zeros(1, dtype=np.intp))
        touches = bodies.touches(np.zeros(1), at)
        if not touches or touches[0].depth < BLOCKED_DEPTH:
            return []
        found.append(touches[0])
    if len(found) < LEAST_AT_HIT:
        return []
    best = min(found, key=lambda touch: touch.depth)
    return [
        f"in each of {len(found)} postures found at the hit point two bodies penetrate each other, in the "
        f"best one {best.one!r} and {best.other!r} by {1e3 * best.depth:.0f} mm; correct their shapes, or "
        "move the point"
    ]


def _postures_at_hit(problem: ImpactProblem) -> Iterator[Array]:
    """Configurations (nq,) with the striking point at the hit point: that of the problem, and random ones."""
    p, posture = problem, problem.contact_posture
    yield posture
    # an arm reaches a point in several ways
    for guess in random_postures(p.robot, p.striker, posture, DRAWN_AT_HIT):
        with contextlib.suppress(InputError):
            yield inverse_kinematics(p.coordinates, p.striker, p.point, guess, starts=1)
