"""The engines by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.bodies.clearance import MISSED, Places
from impactopt.errors import InputError, check_array, check_choice
from impactopt.kinematics.support import support_polygon
from impactopt.problem.problem import ImpactProblem
from impactopt.simulation.collision_geometry import FLOOR, Solid, Solids, UnintendedContact
from impactopt.simulation.controller import controller_of
from impactopt.simulation.mujoco_engine import simulate_mujoco
from impactopt.simulation.pinocchio_engine import simulate_pinocchio
from impactopt.simulation.result import Scene, Simulation

__all__ = ["ALLOWED", "ENGINES", "check_steps", "scene_of", "simulate", "with_clearance", "with_step_error"]


def scene_of(problem: ImpactProblem) -> Scene:
    """Target, contact and fixed soles of ``problem``."""
    p = problem
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
                strikable=body.strikable,
            )
        )
    for joint, w in bodies.world_pairs:
        if w in place:
            pairs += [(number[id(piece)], place[w]) for piece in bodies.links.of_joint[joint]]
    height = problem.ground_height
    return Solids(solids=tuple(solids), pairs=tuple(pairs), floor=0.0 if height is None else height)


Array = NDArray[np.float64]
STEP = 1e-3  # [s] at which a replay is looked at
MOVED = 5e-4  # [rad, m] by which a coordinate has moved since the last look, as at 0.5 rad/s in such a step


def with_clearance(problem: ImpactProblem, simulation: Simulation) -> Simulation:
    """The simulation with its least clearance; and what touched what, where the engine has not said so
    itself.
    """
    time = simulation.time
    chosen = _instants(time, simulation.q, simulation.travel())
    phase = np.full(len(time), MISSED) if simulation.missed else simulation.phase()
    bodies = problem.bodies
    at = Places.of(problem.robot, simulation.q[chosen], simulation.travel()[chosen], phase[chosen])
    found = bodies.survey(time[chosen], at)
    touched = simulation.touched
    if simulation.fall is None or not problem.keeps_apart:  # this replay's robot has no solids
        touched = tuple(
            UnintendedContact(one=t.one, other=t.other, start=t.start, end=t.end, depth=t.depth)
            for t in found.touches
        )
    return replace(
        simulation,
        clearance=found.clearance,
        nearest=found.nearest,
        touched=touched,
    )


def _instants(time: Array, q: Array, travel: Array) -> NDArray[np.intp]:
    """Indices of the first and last instant, and of those at which bodies have moved since the one before."""
    _, every = np.unique(np.floor(time / STEP), return_index=True)
    places = np.column_stack([q, travel])
    chosen = [0]
    for k in map(int, every[1:]):
        if np.abs(places[k] - places[chosen[-1]]).max() > MOVED:
            chosen.append(k)
    return np.unique([*chosen, len(time) - 1])


ALLOWED = 1e-2  # of the impulse
HALVINGS = 3
ALLOWED_RANGE = 1e-3  # [rad] that a joint may be out of its range untold
BEYOND = 0.02  # [s] after the blow that the comparison goes on


def with_step_error(run: Callable[..., Simulation], *given: Any, **options: Any) -> Simulation:
    """The simulation by an engine, with how far off its impulse is by its steps, as an estimate.

    It is compared up to the end of the blow with one of twice the step, or where that was given longer than
    the engine's own with one of that. Where more than 1 % is left, or it diverges, and the step is no longer,
    it is halved, three times at most.
    """
    own = float((run.__kwdefaults__ or {})["step"])
    step = float(options.pop("step", own))
    for left in range(HALVINGS, -1, -1):
        try:
            found = run(*given, **options, step=step)
        except InputError:  # light links on stiff servos need shorter steps
            if step > own or not left:
                raise
            step /= 2
            continue
        found = replace(found, step_error=_error(run, given, options, found, step, own))
        if not found.step_error > ALLOWED or step > own:
            break
        step /= 2
    return found


def _error(
    run: Callable[..., Simulation],
    given: tuple[Any, ...],
    options: dict[str, Any],
    found: Simulation,
    step: float,
    own: float,
) -> float:
    """Relative to the larger of the impulses; nan where both have missed the target."""
    until = np.inf if np.isnan(found.contact_end) else found.contact_end + BEYOND
    if found.missed or (until == np.inf and step <= own):
        return np.nan
    for other in (own if step > own else 2 * step, step / 2):
        try:
            compared = run(*given, **options, step=other, until=until)
        except InputError:
            continue  # twice the step may be too long for the servo
        impulses = [sum(touch[2] for touch in s.touches if touch[0] <= until) for s in (found, compared)]
        largest = max(impulses)
        return abs(impulses[0] - impulses[1]) / largest if largest > 0 else np.nan
    return np.inf


def check_steps(found: Simulation, step: float | None) -> None:
    """InputError where the steps leave more than 1 % of the impulse uncertain."""
    if found.step_error > ALLOWED:
        given = "the engine's steps leave" if step is None else f"steps of {step:g} s leave"
        raise InputError(
            f"the replay is not to be trusted: {given} {100 * min(found.step_error, 1.0):.2g} % of its "
            f"impulse, {found.impulse:.4g} N s, uncertain; give a shorter step (--step), or a softer contact"
        )


ENGINES: dict[str, Callable[..., Simulation]] = {
    "pinocchio": simulate_pinocchio,
    "mujoco": simulate_mujoco,
}


STEPS = (1e-6, 1e-2)  # [s]: below, a replay takes hours; above, it steps over most contacts
LONGEST = 60.0  # [s] beyond the motion: what falls has fallen in a tenth of that
MOST_STEPS = 20_000_000  # an hour's work


def simulate(
    problem: ImpactProblem, reference: Any, *, engine: str = "pinocchio", **options: Any
) -> Simulation:
    """Re-simulate a reference for a problem: "pinocchio" holds the soles, "mujoco" holds nothing.

    reference : as of :class:`impactopt.transcription.plan.Trajectory`.  options : of the engine, such as
        ``step`` [s]; of "mujoco" also ``controller``, "servo" or "wbc", or its settings.

    Raises
    ------
    InputError : an unknown engine or option; a step or a time beyond the motion that no replay has.
    """
    check_choice("unknown engine", engine, ENGINES)
    run = ENGINES[engine]
    known = set(run.__kwdefaults__ or {})
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
    _check_times({**(run.__kwdefaults__ or {}), **options}, float(reference.end))
    found = with_step_error(run, problem.robot, reference, scene_of(problem), **options)
    name, beyond = problem.robot.ranges.excess(problem.robot.joint_positions(found.q))
    beyond_range = (name, beyond) if beyond > ALLOWED_RANGE else ("", 0.0)
    found = replace(found, expected=float(reference.contact_start), beyond_range=beyond_range)
    return with_clearance(problem, found)


def _check_times(options: Mapping[str, Any], end: float) -> None:
    """InputError for a step or a time to settle that is out of its range."""
    given = {name: 0.0 if options[name] is None else options[name] for name in ("step", "settle")}
    step, settle = (float(check_array(f"{name} [s]", value, ())) for name, value in given.items())
    if not STEPS[0] <= step <= STEPS[1]:
        raise InputError(f"step [s]: {step:g}; give a number of {STEPS[0]:g} to {STEPS[1]:g}")
    if not 0 <= settle <= LONGEST:
        raise InputError(f"settle [s]: {settle:g}; give a number of 0 to {LONGEST:g}")
    if (end + settle) / step > MOST_STEPS:
        raise InputError(
            f"a replay of {end + settle:g} s in steps of {step:g} s has {(end + settle) / step:.2g} of them; "
            f"give a longer step, for at most {MOST_STEPS:.2g}"
        )
