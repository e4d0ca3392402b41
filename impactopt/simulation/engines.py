"""Replay of a problem's reference by an engine, with checks of its steps and of clearance."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from impactopt.arrays import Array, Index, Mask
from impactopt.bodies.clearance import MISSED, Places
from impactopt.errors import InputError, check_array, check_choice, check_kind, check_number, check_whole
from impactopt.kinematics.stance import support_polygon
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import HitRegion
from impactopt.robots.robot import Robot
from impactopt.simulation.collision_geometry import FLOOR, Solid, Solids, UnintendedContact
from impactopt.simulation.controller import ControllerSettings, controller_of
from impactopt.simulation.motors import Servo
from impactopt.simulation.mujoco_engine import simulate_mujoco
from impactopt.simulation.perturbation import Perturbation
from impactopt.simulation.pinocchio_engine import simulate_pinocchio
from impactopt.simulation.pinocchio_robot import recursive_body
from impactopt.simulation.result import FACE, Scene, Simulation, state_at_contact
from impactopt.transcription.plan import Trajectory


def has_mujoco() -> bool:
    """True if the engine "mujoco" is installed."""
    return importlib.util.find_spec("mujoco") is not None


def scene_of(problem: ImpactProblem) -> Scene:
    """Target, contact and fixed soles of ``problem``."""
    p, region = problem, problem.extra(HitRegion)
    return Scene(
        solids=solids_of(p) if p.keeps_apart else Solids(),
        point=p.point,
        normal=p.normal,
        law=p.law,
        target=p.target,
        friction=p.friction,
        striker=p.robot.striker(p.striker).model_frame,
        soles=tuple(sole.frame for sole in p.soles),
        hands=p.stance.hand_frames(p.robot),
        second=None if p.second is None else (p.robot.striker(p.second.striker).model_frame, p.second.point),
        corners=tuple(sole.polygon for sole in p.soles),
        polygon=support_polygon(p.robot, p.coordinates),
        standing=p.standing if p.stances else np.zeros((0, 0), dtype=bool),
        polygons=tuple(support_polygon(p.robot, c) for c in p.stance_coordinates) if p.stances else (),
        face=FACE + (region.reach if region is not None else 0.0),
    )


def solids_of(problem: ImpactProblem) -> Solids:
    """Hulls of the robot's links, bodies of the world, and the pairs of them that must not touch."""
    bodies = problem.bodies
    hulls = bodies.links.pieces
    solids = [Solid(name=hull.link, joint=hull.joint, vertices=hull.vertices) for hull in hulls]
    number = {id(hull): k for k, hull in enumerate(hulls)}
    pairs = [(number[id(a)], number[id(b)]) for of_links in bodies.pairs.values() for a, b in of_links]
    world_number = dict[int, int]()  # of the world's bodies, among the solids
    # not those of `bodies`, which lower the ground for links that begin on it: these do not collide with it
    for w, body in enumerate(problem.world):
        if body.ground:
            world_number[w] = FLOOR
        if body.ground or body.core:
            continue
        world_number[w] = len(solids)
        solids.append(
            Solid(
                name=body.name,
                half=body.half,
                radius=body.radius,
                place=body.place,
                rotation=body.rotation,
                of_target=body.of_target,
                moves=body.moves,
                strikable=body.strikable,
            )
        )
    for joint, w in bodies.world_pairs:
        if w in world_number:
            pairs += [(number[id(hull)], world_number[w]) for hull in bodies.links.of_joint[joint]]
    height = problem.ground_height
    return Solids(solids=tuple(solids), pairs=tuple(pairs), floor=0.0 if height is None else height)


SAMPLING = 1e-3  # [s] between instants at which a replay's clearance may be computed
# [rad, m] by which a coordinate must have moved since the last computation, as at 0.5 rad/s in `SAMPLING`
MIN_MOTION = 5e-4


def with_clearance(problem: ImpactProblem, simulation: Simulation, distance: float) -> Simulation:
    """Simulation with its least clearance, and with unintended contacts if the engine has recorded none.

    distance [m] : displacement of the target along the normal, by a perturbation.
    """
    time = simulation.time
    chosen = _sampled(time, simulation.q, simulation.target_travel)
    phase = np.full(len(time), MISSED) if simulation.missed else simulation.phase()
    bodies = problem.bodies.with_target_moved(distance * problem.normal)
    moved = np.outer(simulation.target_travel, problem.normal) + simulation.aside()
    at = Places.of(problem.robot, simulation.q[chosen], phase[chosen], moved[chosen])
    survey = bodies.survey(time[chosen], at)
    touched = simulation.touched
    if simulation.fall is None or not problem.keeps_apart:  # the engine had no solids that collide
        touched = tuple(UnintendedContact(**touch._asdict()) for touch in survey.touches)
    return replace(simulation, clearance=survey.clearance, nearest=survey.nearest, touched=touched)


def _sampled(time: Array, q: Array, travel: Array) -> Index:
    """Indices of the first and last instant, and of those at which bodies have moved since the one before."""
    # the first recorded instant in each millisecond, as in contact all steps are recorded
    _, every = np.unique(np.floor(time / SAMPLING), return_index=True)
    coordinates = np.column_stack([q, travel])
    chosen = [0]
    for k in map(int, every[1:]):
        if np.abs(coordinates[k] - coordinates[chosen[-1]]).max() > MIN_MOTION:
            chosen.append(k)
    return np.unique([*chosen, len(time) - 1])


ALLOWED = 1e-2  # error of the impulse by the steps, relative
HALVINGS = 3  # of the step, at most
REGULAR = (1.5, 4.5)  # growth of an impulse's change from one doubling of a short step to the next
ALLOWED_RANGE = 1e-3  # [rad] out of range that is not reported
COMPARED_AFTER = 0.02  # [s] after the impact up to which two simulations are compared
STEP_RANGE = (1e-6, 1e-2)  # [s]: below, a replay takes hours; above, it steps over most contacts
RATE_POSTURES = 8  # of the reference, in which the servo's rate is computed: it varies slowly


def longest_stable_step(
    robot: Robot,
    reference: Any,
    scene: Scene,
    *,
    perturbation: Perturbation | None = None,
    controller: ControllerSettings | None = None,
) -> float:
    """Longest step [s] with which both engines integrate the servo stably, with a margin; inf without gains.

    It is the reciprocal of the servo's fastest rate, of damping alone or of stiffness alone, with nothing
    fixed. The engines' rules are explicit in the torque, and stable up to nearly twice as much. Torque limits
    bound an instability, so that the impulse does not show it, but demand, saturation and gear loads do.

    A servo that is sampled more slowly needs no shorter steps than its period; dampers of joints without a
    motor do.

    Raises
    ------
    InputError : a rate that is too fast for any step.
    """
    world = perturbation or Perturbation()
    period = world.period or (0.0 if controller is None else controller.period)
    servo = Servo(robot, reference, kp=world.kp, kd=world.kd)
    body = recursive_body(robot, (), np.zeros(6), scene.strikers, scene.normal)

    def longest(joints: Mask) -> float:
        if not joints.any():
            return np.inf
        rates = [0.0]
        for k in np.unique(np.linspace(0, len(reference.q) - 1, RATE_POSTURES).astype(int)):
            body.update(np.array(reference.q[k]), np.zeros(robot.nv))
            damping, stiffness = (
                body.fastest_rate(np.diag(joints * gains)) for gains in (servo.kd, servo.kp)
            )
            rates += [damping, np.sqrt(stiffness)]
        return 1 / fastest if (fastest := max(rates)) > 0 else np.inf

    step = longest(np.ones(robot.n, dtype=bool))
    if period > step:
        step = min(period, longest(robot.passive))
    if step < STEP_RANGE[0]:
        raise InputError(
            f"the servo has a rate of {1 / step:.2g} 1/s, too fast for steps of {STEP_RANGE[0]:g} s; lower "
            "the perturbation's kp and kd"
        )
    return step


def with_step_error(run: Callable[..., Simulation], *given: Any, **options: Any) -> Simulation:
    """Simulation by an engine, with an estimate of its impulse's error by the steps.

    The step is at most that of `longest_stable_step`, and divides a controller's own period, as it is else
    sampled at another rate; so do the steps of comparison. Impulses up to the end of the impact are compared
    with those of about two and four times the step. The error is the change for twice the step if the changes
    grow as they do where steps are short; else it is the spread of all three. Of a step that is longer than
    the engine's default, or nearly unstable, the difference from a shorter one is added to the error of that.
    If the error is above 1 %, or the simulation diverges, the step is halved, at most three times; a given
    step longer than the default is kept.
    """
    # the default of the engine's signature
    own = float((run.__kwdefaults__ or {})["step"])
    controller, world = options.get("controller"), options.get("perturbation") or Perturbation()
    longest = longest_stable_step(*given, perturbation=world, controller=controller)
    step = min(float(options.pop("step", own)), longest)
    period = 0.0 if controller is None or world.period else controller.period
    if period:
        longest, step, own = min(longest, period), _divided(period, step), _divided(period, own)
    for left in range(HALVINGS, -1, -1):
        try:
            simulation = run(*given, **options, step=step)
        except InputError:  # light links on stiff servos need shorter steps
            if step > own or not left:
                raise
            step /= 2
            continue
        error = _step_error(run, given, options, simulation, step, own, longest, period)
        simulation = replace(simulation, step_error=error)
        if not simulation.step_error > ALLOWED or step > own:
            break
        step /= 2
    return simulation


def _divided(period: float, step: float) -> float:
    """Longest step [s] that divides a period [s] and is no longer than `step`."""
    return period / math.ceil((1 - 1e-9) * period / step)


def _step_error(
    run: Callable[..., Simulation],
    given: tuple[Any, ...],
    options: dict[str, Any],
    simulation: Simulation,
    step: float,
    own: float,
    stable: float,
    period: float,
) -> float:
    """Estimated error of a simulation's impulse, relative to the largest that is compared; nan if all missed.

    own, stable, period [s] : default step of the engine; `longest_stable_step`; a controller's own, else 0.
    """
    end = simulation.contact_end
    until = np.inf if np.isnan(end) else end + COMPARED_AFTER
    if simulation.missed or (until == np.inf and step <= own):
        return np.nan
    shortest = min(step, own)
    while 4 * shortest >= 2 * stable:  # longer ones are unstable
        shortest /= 2
    steps = [shortest, 2 * shortest, 4 * shortest]
    if period:
        count = math.ceil((1 - 1e-9) * period / shortest)
        steps = [period / max(count // k, 1) for k in (1, 2, 4)]
    # an engine rounds the time at which it ends to steps; up to `last` there are all simulations
    longest = max(step, steps[-1])
    last = min(until, options.get("until", np.inf) - longest)
    found = simulation.impulse_until(last)

    def impulse(other: float) -> float:
        if math.isclose(other, step):
            return found
        try:
            compared = run(*given, **{**options, "step": other, "until": last + longest})
        except InputError:
            return np.nan  # too long for the servo
        return compared.impulse_until(last)

    compared = np.array([impulse(other) for other in steps])
    known = compared[np.isfinite(compared)]
    if np.isnan(compared[0]) or len(known) < 2:
        return np.inf
    double, fourfold = np.diff(compared)
    # of an engine of first order the change doubles with the step, of second order it grows fourfold
    growth = fourfold / double if double else np.nan
    left = np.ptp(known)
    if REGULAR[0] <= growth <= REGULAR[1]:
        left = abs(double) / min(growth - 1, 1.0)
    largest = max(found, *known)
    return float((abs(found - compared[0]) + left) / largest) if largest > 0 else np.nan


def check_steps(simulation: Simulation, step: float | None) -> None:
    """Raises an InputError if the steps leave more than 1 % of the impulse uncertain."""
    error, impulse = simulation.step_error, simulation.impulse
    if error > ALLOWED:
        given = "the engine's steps leave" if step is None else f"steps of {step:g} s leave"
        raise InputError(
            f"the replay is not reliable: {given} {100 * min(error, 1.0):.2g} % of its impulse, "
            f"{impulse:.4g} N s, uncertain; give a shorter step (--step), or a softer contact"
        )


ENGINES: dict[str, Callable[..., Simulation]] = {
    "pinocchio": simulate_pinocchio,
    "mujoco": simulate_mujoco,
}


MAX_SETTLE = 60.0  # [s] beyond the motion: a robot that falls has fallen after a tenth of that
MAX_STEPS = 20_000_000  # an hour of computing


def simulate(
    problem: ImpactProblem, reference: Any, *, engine: str = "pinocchio", **options: Any
) -> Simulation:
    """Re-simulates a reference for a problem: "pinocchio" fixes the soles, "mujoco" leaves the robot free.

    reference : as :class:`impactopt.transcription.plan.Trajectory`.
    options : of the engine, such as ``step`` [s], which is shortened as in :func:`with_step_error`; of
        "mujoco" also ``controller``, "servo" or "wbc", or its settings.

    Raises
    ------
    InputError : an unknown engine or option; an option of a wrong kind or out of its range.
    """
    check_choice("unknown engine", engine, ENGINES)
    run = ENGINES[engine]
    known = run.__kwdefaults__ or {}
    if "controller" in options:
        options["controller"] = controller_of(options["controller"])
        if "controller" not in known and options.pop("controller") is not None:
            raise InputError(f"engine {engine!r} has the joints' servo only; take engine 'mujoco'")
    for name in options:
        if name == "perturbation" and name not in known:
            raise InputError(
                f"engine {engine!r} replays what was planned, no perturbation; take engine 'mujoco'"
            )
        check_choice(f"engine {engine!r} has no option", name, sorted(known))
    _check_options(options, known, float(reference.end))
    simulation = with_step_error(run, problem.robot, reference, scene_of(problem), **options)
    name, beyond = problem.robot.ranges.excess(problem.robot.joint_positions(simulation.q))
    beyond_range = (name, beyond) if beyond > ALLOWED_RANGE else ("", 0.0)
    simulation = replace(
        simulation,
        expected=float(reference.contact_start),
        expected_state=state_at_contact(reference),
        beyond_range=beyond_range,
    )
    perturbation = options.get("perturbation") or Perturbation()
    return with_clearance(problem, simulation, perturbation.distance)


def _check_options(given: Mapping[str, Any], defaults: Mapping[str, Any], end: float) -> None:
    """Raises an InputError for an option of an engine of a wrong kind or out of its range.

    end [s] : of the reference.
    """
    options = {**defaults, **given}
    for name in {"record", "iterations"} & {*options}:
        check_whole(name, options[name], least=1, most=MAX_STEPS)
    if (tolerance := check_number("tolerance", options.get("tolerance", 0.0))) < 0:
        raise InputError(f"tolerance: {tolerance:g}; give a number >= 0")
    check_kind("missing", options.get("missing", False), bool)
    for name, kind in {"perturbation": Perturbation, "missed": Trajectory}.items():
        if options.get(name) is not None:
            check_kind(name, options[name], kind)
    step = float(check_array("step [s]", options["step"], ()))
    # None of an engine that has a default of its own
    none = options["settle"] is None and defaults["settle"] is None
    settle = 0.0 if none else float(check_array("settle [s]", options["settle"], ()))
    if not STEP_RANGE[0] <= step <= STEP_RANGE[1]:
        raise InputError(f"step [s]: {step:g}; give a number of {STEP_RANGE[0]:g} to {STEP_RANGE[1]:g}")
    if not 0 <= settle <= MAX_SETTLE:
        raise InputError(f"settle [s]: {settle:g}; give a number of 0 to {MAX_SETTLE:g}")
    if options["until"] != np.inf and check_array("until [s]", options["until"], ()) < step:
        raise InputError(f"until [s]: {options['until']:g}; give a time of at least one step, {step:g} s")
    if (end + settle) / step > MAX_STEPS:
        raise InputError(
            f"a replay of {end + settle:g} s in steps of {step:g} s has {(end + settle) / step:.2g} of them; "
            f"give a longer step, for at most {MAX_STEPS:.2g}"
        )
