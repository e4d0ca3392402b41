"""Draft of a whole problem file from a robot's description."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from impactopt.arrays import Array, Mask
from impactopt.bodies.convex_hulls import seen_pieces
from impactopt.bodies.robot_bodies import bodies_of, striker_face
from impactopt.errors import InputError, counted
from impactopt.files.draft.default_drives import DOUBT, published_limits
from impactopt.files.draft.hits import FORCE_PER_MASS, Hit, hits
from impactopt.files.draft.limbs import HELD, NO_RANGE, Limb, renumbered
from impactopt.files.draft.postures import eased, half_sitting, rested
from impactopt.files.draft.robot import FIXED, Drafted, draft_robot
from impactopt.files.draft.soles import find_soles, sides
from impactopt.files.draft.strikers import find_edge, find_striker, find_toe
from impactopt.files.draft.strong import FOLLOW, SWING, TRIAL, Strong, durations, strongest
from impactopt.files.draft.target_placement import STRIKE_DIRECTIONS, Arm, aims, ready
from impactopt.files.problem_file.reading import ProblemFile
from impactopt.files.problem_file.sections import comment_at
from impactopt.files.problem_file.writing import ROBOT_KEYS, relative_path, section_data, sole_data
from impactopt.files.sections.robot import StrikerSection, ToolSection
from impactopt.files.toml import Place, plain_value, write_toml
from impactopt.kinematics.operational_space import striking_point
from impactopt.planning.solution import Solution
from impactopt.planning.solve import solve
from impactopt.planning.strike import StrikeSolution, optimize_strike
from impactopt.problem.feasibility import hopeless, too_weak
from impactopt.problem.plausibility import shape_doubts, unit_doubts
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.strength import DOWN, touches
from impactopt.problem.terms import Slide
from impactopt.robots.attachments import Sole, Striker, Tool
from impactopt.robots.build import default_kd, default_kp
from impactopt.robots.checks import REPAIRED
from impactopt.robots.gains import USUAL_ROTOR
from impactopt.robots.robot import Robot

MAX_TARGETS = 8  # tried
MAX_MOTIONS = 2  # whole motions of a bolted arm that are compared
# A strike is planned for if its objective is at least so much of the hardest motion's.
WORTH_A_PLAN = 1.05
SLIGHT = 0.35  # component of a direction that is not named in words: 20 degrees
MAX_STROKES = 3  # targets of a robot on legs, below its hand, that a strike is tried to
SHIFT = (0.6, 1.2)  # duration [s] from two feet to one, and back
START, AT_CONTACT = "ready", "contact"  # postures
FROM_ABOVE = ("chop", "nail")
MOTIONS = ("punch", "kick", *FROM_ABOVE)
UNSOLVED = "none of the strikes tried is solved: if `solve` finds no motion, move the target or ease it"
NEAREST = "; the nearest strike: "
EDGEWISE = (
    "no strike with the striking link's face to the target is found: [terms.first_touch] is off, so another "
    "part of the link may touch first"
)
PEG, PEG_MASS = 0.05, 0.1  # [m], [kg]
PEGGED = (
    f"a peg of {100 * PEG:g} cm is drafted on the striking link, as the links before it would touch the "
    "target first: mount one, or give your own tool in [[robot.tools]]"
)
TURNED = "two limbs would be legs if the root were turned {}: if the robot is to stand, turn it in the file"
BALL = 0.22  # [m] largest diameter
KICKS = (0.3, 0.2, 0.4)  # distances of the ball ahead over the hip's height, in the order tried


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A drafted problem file; said : messages for the user."""

    text: str
    said: tuple[str, ...]


def draft_problem(
    path: Path,
    *,
    folder: Path,
    mjcf: bool = False,
    bolted: bool = False,
    motion: str | None = None,
    planned: bool = True,
    report: Callable[[str], None] | None = None,
) -> Draft:
    """The text of a problem file for the robot of a URDF, or an MJCF.

    folder : folder of the file to be written.  bolted : fix the robot to the ground, even if it has legs.
    motion : "punch", "kick", "chop" (a board, from above) or "nail" (with the hand, from above); None: a kick
        for a robot on legs without arms, else a punch.
    planned : for a bolted arm, also solve for the whole motion, and take the next strike if that fails.
    report : called with messages on the progress.

    Raises
    ------
    InputError : the file cannot be read; the robot cannot be planned for, with the reason; no posture or no
        target is found; an unknown motion, or a kick of a robot without legs.
    """
    if motion not in (None, *MOTIONS):
        raise InputError(f"motion: {motion!r}; give {', '.join(MOTIONS[:-1])} or {MOTIONS[-1]}")
    say = report or (lambda text: None)
    say("reading the robot and the shapes of its links")
    drafted = draft_robot(path, mjcf=mjcf, bolted=bolted)
    try:
        return _of_motion(drafted, motion, folder, say, planned=planned)
    except InputError as error:
        # the reason, where a robot of that size, with such shapes or limits has no sole or posture
        causes = [*unit_doubts(drafted.robot), *shape_doubts(drafted.robot)]
        for why, what in ((NO_RANGE, "without a range"), (FIXED, FIXED), (HELD, "held by their damping")):
            if names := sorted(joint for joint, reason in drafted.locked.items() if reason == why):
                causes.append(f"joints {what}, locked: {', '.join(names)}")
        if drafted.turn:
            causes.append(TURNED.format(drafted.turn))
        if not causes:
            raise
        raise InputError("; ".join([*causes, str(error)])) from error


@dataclass(frozen=True, kw_only=True)
class _Case:
    """A robot to draft for, and what is found on it.

    arms : the one that strikes first.  forward (3,) : in the root's frame.  folder : of the file.
    say : reports progress.
    """

    drafted: Drafted
    soles: list[Sole]
    forward: Array
    strikers: list[Striker]
    arms: list[Arm]
    folder: Path
    say: Callable[[str], None]

    @property
    def joints(self) -> str:
        """Text with the robot's name and number of joints."""
        return f"{self.drafted.robot.name}: {self.drafted.robot.n} joints"


def _of_motion(
    drafted: Drafted, motion: str | None, folder: Path, say: Callable[[str], None], *, planned: bool
) -> Draft:
    """Draft of the motion, or, if that is None, of the first one that the robot can do."""
    path, model, forward = drafted.path, drafted.robot.model, np.array(STRIKE_DIRECTIONS[0])
    soles: list[Sole] = []
    if drafted.legs:
        soles, forward = find_soles(model, drafted.legs, drafted.pieces)
    if motion == "kick" and not soles:
        raise InputError(f"{path}: it does not stand on legs, so it cannot kick")
    arms, strikers = _arms(drafted)
    if motion not in (None, "kick") and not arms:
        raise InputError(f"{path}: there is no limb beside the legs to {motion} with; let it kick")
    case = _Case(
        drafted=drafted, soles=soles, forward=forward, strikers=strikers, arms=arms, folder=folder, say=say
    )
    if soles and (motion == "kick" or not arms):
        return _kick(case)
    if soles and motion in FROM_ABOVE:
        return _stroke(case, motion)
    if not soles:
        return _bolted(case, motion, planned=planned)
    say(f"{case.joints}, on two legs; looking for a posture and a target")
    try:
        return _punch(case)
    except InputError as no_punch:
        if motion == "punch":
            raise
        try:
            kick = _kick(case)
        except InputError:
            raise no_punch from None
        return replace(kick, said=(*kick.said, f"a kick is drafted, as there is no punch: {no_punch}"))


def _draft(data: dict[str, Any], drafted: Drafted, robot: Robot, *messages: str) -> Draft:
    """Draft of a file's data, with its own messages and others."""
    return Draft(text=_text(data, drafted, robot), said=(*_messages(data, drafted, robot), *messages))


def _standing(case: _Case) -> tuple[Robot, tuple[Limb, ...], Array]:
    """The robot with soles and strikers, its legs, and its half-sitting configuration (nq,)."""
    drafted, soles = case.drafted, case.soles
    robot = drafted.made(soles=soles, strikers=case.strikers)
    legs = tuple(renumbered(leg, drafted.robot.model, robot.model) for leg in drafted.legs)
    return robot, legs, half_sitting(robot, legs, soles, case.forward)


def _renumbered(arms: Sequence[Arm], drafted: Drafted, robot: Robot) -> list[Arm]:
    """The arms with joint indices of a robot with more joints or frames."""
    return [replace(arm, limb=renumbered(arm.limb, drafted.robot.model, robot.model)) for arm in arms]


def _punch(case: _Case) -> Draft:
    """Draft of a punch ahead by a robot on its legs.

    Raises
    ------
    InputError : no posture or no target is found.
    """
    robot, _, q = _standing(case)
    arms = _renumbered(case.arms, case.drafted, robot)
    q, way = ready(robot, arms, q, directions=STRIKE_DIRECTIONS[:1])
    data = _data(case, robot, q)
    # from the start: a push that slides off the target is refused for its replay before its slide is bounded
    data["terms"]["slide"] = {"most_m": Slide().most}
    data, _ = _aimed(data, arms[0].name, aims(robot, arms[0], q, way), way, case.folder)
    return _draft(data, case.drafted, robot)


def _bolted(case: _Case, motion: str | None, *, planned: bool) -> Draft:
    """Draft for a robot on a fixed base: the hardest of the strikes that are solved, else a target within
    reach.

    Raises
    ------
    InputError : no posture or no target is found.
    """
    drafted, folder, say = case.drafted, case.folder, case.say
    robot = drafted.made(soles=[], strikers=case.strikers)
    arms = _renumbered(case.arms, drafted, robot)
    say(f"{case.joints}, on a fixed base; trying strikes (compiles the first time)")
    q = eased(robot, [arm.limb for arm in arms[1:]], rested(robot))
    targets = hits(motion, robot)
    strong, hit, edgewise, why = _hardest(robot, arms[0], q, targets)
    pegged = not strong
    if pegged:  # the striking point may be behind the links: try again with one ahead of it
        other, with_peg = robot.with_tool(_peg(robot, arms[0])), replace(arms[0], name="peg")
        strong, hit, edgewise, _ = _hardest(other, with_peg, q, targets)
        robot, arms = (other, [with_peg, *arms[1:]]) if strong else (robot, arms)
    if strong:
        striking = arms[0]

        @cache
        def strike_of(k: int) -> tuple[dict[str, Any], ImpactProblem]:
            return _aimed_strike(case, robot, striking, strong[k], hit, edgewise)

        best = _hardest_planned(lambda k: strike_of(k)[1], strong, say) if planned else None
        data, problem = strike_of(best[0] if best else 0)
        # more time does not help motors that cannot hold the arm
        weak = too_weak(problem) if planned and not best else ""
        if planned and not best and not weak:
            best = _hardest_planned(lambda k: _built(_slower(strike_of(k)[0]), folder), strong, say)
            data = _slower(strike_of(best[0] if best else 0)[0])
        messages = [
            _strike_message(strong, best, tried=planned),
            *([weak] if weak else []),
            *([EDGEWISE] if edgewise else []),
            *([PEGGED] if pegged else []),
        ]
    else:
        try:
            q, way = ready(
                robot, arms, q, directions=[tuple(DOWN)] if motion in FROM_ABOVE else STRIKE_DIRECTIONS
            )
            data = {**_data(case, robot, q), **hit.data}
            data, _ = _aimed(data, arms[0].name, aims(robot, arms[0], q, way), way, folder)
        except InputError as no_target:
            below = -float(striking_point(robot, arms[0].name, rested(robot))[2])
            if below > 0:
                raise InputError(
                    f"{drafted.path}: no target is found: bolted with its root on the ground, the robot's "
                    f"{arms[0].name!r} hangs {below:.2g} m below the ground; place the root higher in the "
                    "file, such as by a fixed joint from a link `world`, or do not bolt a robot with legs"
                ) from no_target
            if not why:
                raise
            raise InputError(f"{drafted.path}: no strike of {arms[0].name!r} is found{why}") from no_target
        messages = [UNSOLVED + why]
    return _draft(data, drafted, robot, *messages)


def _hardest(robot: Robot, arm: Arm, q: Array, targets: list[Hit]) -> tuple[list[Strong], Hit, bool, str]:
    """Solved strikes of the first target that has some, the target, True if edgewise, and a reason.

    Without any an empty list and the last target. The reason is that of the last unsolved strike, "" if there
    was none.
    """
    why = ""
    # edgewise last: for an arm of few joints, which cannot turn the link's face to its direction of motion;
    # a link of unknown shape is not asked to
    ways = (False,) if striker_face(robot, arm.name) is None else (False, True)
    for edgewise, hit in product(ways, targets):
        strong, message = strongest(robot, arm, q, hit, with_face=not edgewise)
        if strong:
            break
        why = f"{NEAREST}{message}" if message else why
    return strong, hit, edgewise, why


def _slower(data: dict[str, Any]) -> dict[str, Any]:
    """The data with doubled upper bounds of the durations."""
    durations = {key: data[key]["duration_s"] for key in ("swing", "follow")}
    return data | {key: data[key] | {"duration_s": [low, 2 * high]} for key, (low, high) in durations.items()}


def _peg(robot: Robot, arm: Arm) -> Tool:
    """A rod from the striking point of an arm along its axis, whose end is the new striking point."""
    striker = robot.striker(arm.name)
    frame = robot.model.frames[robot.model.getFrameId(striker.frame)]
    axis = np.round(frame.placement.rotation.T @ arm.axis, 4) + 0.0
    across, along = PEG_MASS * PEG**2 / 12, PEG_MASS * 0.01**2 / 2
    return Tool(
        name="peg",
        frame=striker.frame,
        mass=PEG_MASS,
        center=np.round(striker.point + PEG / 2 * axis, 4),
        inertia=np.round(across * np.eye(3) + (along - across) * np.outer(axis, axis), 8),
        head=np.round(striker.point + PEG * axis, 4),
    )


def _aimed_strike(
    case: _Case, robot: Robot, arm: Arm, strong: Strong, hit: Hit, edgewise: bool
) -> tuple[dict[str, Any], ImpactProblem]:
    """Data of a bolted arm's strike, and its problem."""
    data = {**_data(case, robot, strong.start), **hit.data}
    way = robot.joint_positions(strong.contact) - robot.joint_positions(strong.start)
    for phase, bounds in durations(robot, way).items():
        data[phase]["duration_s"] = list(bounds)
    data = _edgewise(data) if edgewise else data
    data["robot"]["postures_rad"][AT_CONTACT] = _angles(robot, strong.contact)
    return _aimed(data, arm.name, iter([strong.point]), strong.normal, case.folder)


def _stroke(case: _Case, motion: str) -> Draft:
    """Draft of a strike from above by a robot on its legs, with the lower side of the hand.

    Raises
    ------
    InputError : the hand has no shape; no posture or no target is found.
    """
    drafted, folder, arm = case.drafted, case.folder, case.arms[0]
    case.say(f"{case.joints}, on two legs; looking for a strike from above")
    robot, _, q = _standing(case)
    (hand,) = _renumbered([arm], drafted, robot)
    q, _ = ready(robot, [hand], q, directions=STRIKE_DIRECTIONS[:1])
    name = arm.name.removesuffix("hand") + "edge"
    edge, below = find_edge(robot.model, hand.limb, name, bodies_of(robot).of_joint, arm.axis, q)
    case = replace(case, strikers=[*case.strikers, edge])
    robot, _, q = _standing(case)
    (hand,) = _renumbered([Arm(limb=arm.limb, name=name, axis=below)], drafted, robot)
    q, way = ready(robot, [hand], q, directions=[tuple(DOWN)])
    # the easiest target: on soles, a strike alone is far harder than the strike of a whole motion
    data = {**_data(case, robot, q), **hits(motion, robot)[-1].data}
    points, tried = aims(robot, hand, q, way), list[tuple[dict[str, Any], StrikeSolution]]()
    case.say("trying strikes with any part of the hand (compiles the first time)")
    while len(tried) < MAX_STROKES and not any(solved.status.usable for _, solved in tried):
        try:
            aimed, _ = _aimed(data, name, points, way, folder)
        except InputError:
            if not tried:
                raise
            break
        tried.append((aimed, _strike(_edgewise(aimed), folder)))
    data, solved = min(tried, key=lambda one: (not one[1].status.usable, one[1].result.max_violation))
    messages = list[str]()
    if not solved.status.usable:
        messages = [f"{UNSOLVED}{NEAREST}{solved.result.message}"]
    else:
        # with the face to the target, most strikes are only solved from this one as the initial guess
        case.say("turning the hand's face to the target")
        if not _strike(data, folder, start=solved).status.usable:
            data, messages = _edgewise(data), [EDGEWISE]
    return _draft(data, drafted, robot, *messages)


def _edgewise(data: dict[str, Any]) -> dict[str, Any]:
    """The data without the term that the link's face touches first."""
    return {**data, "terms": {**data.get("terms", {}), "first_touch": {"enabled": False}}}


def _strike(data: dict[str, Any], folder: Path, *, start: StrikeSolution | None = None) -> StrikeSolution:
    """Strike of drafted data, from the plain initial guess or another strike."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a failed trial is no result
        return optimize_strike(_built(data, folder), start=start, options=TRIAL)


def _kick(case: _Case) -> Draft:
    """Draft of a kick from two feet and back to them, with the toe, against a ball on the ground.

    Raises
    ------
    InputError : a sole has a hinge; no posture or no target is found.
    """
    drafted, soles = case.drafted, case.soles
    if any(sole.hinge is not None for sole in soles):
        raise InputError(
            f"{drafted.path}: legs of five joints cannot kick: a foot in the air would swing on its hinge; "
            + ("let it punch" if drafted.arms else "bolt it to the ground (--bolted)")
        )
    lifted = max(range(len(soles)), key=lambda k: soles[k].name == "right")
    foot, stands = soles[lifted], soles[1 - lifted]
    toe = find_toe(drafted.robot.model, drafted.legs[lifted].tip, foot, drafted.pieces)
    case = replace(case, strikers=[*case.strikers, toe])
    robot, legs, q = _standing(case)
    at = striking_point(robot, toe.name, q)
    kinematics = robot.model.createData()
    pin.forwardKinematics(robot.model, kinematics, q)
    hip_height = float(kinematics.oMi[legs[1 - lifted].own[0]].translation[2])
    data = _data(case, robot, q)
    size = float(f"{min(BALL, 0.3 * hip_height):.2g}")
    mass = float(f"{np.clip(0.005 * sum(body.mass for body in robot.model.inertias), 0.1, 0.45):.2g}")
    both = {"soles": [sole.name for sole in soles], "duration_s": list(SHIFT), "intervals": 8, "grading": 1.0}
    data["stances"] = [both, {"soles": [stands.name]}, both]
    data["target"] = {"mass_kg": mass, "body": {"shape": "ball", "size_m": [size]}}
    data["contact"] = {"stiffness_N_m": 2e4, "damping_N_s_m": 20.0}
    points = (np.round([part * hip_height, at[1], size / 2], 3) + 0.0 for part in KICKS)
    data, _ = _aimed(data, toe.name, points, np.array(STRIKE_DIRECTIONS[0]), case.folder)
    return _draft(data, drafted, robot)


def _hardest_planned(
    problem_of: Callable[[int], ImpactProblem], strong: list[Strong], say: Callable[[str], None]
) -> tuple[int, float] | None:
    """Index of the strike with the hardest motion, of at most `MAX_MOTIONS` that are solved, and the motion's
    objective; None if none is solved.

    A solved strike may have no motion, as links may be beyond the target's plane just before it. A motion is
    hardly ever harder than its strike, so the search ends at a strike that is weaker than the best motion.
    Motions are solved at their nodes first, which is quicker. The hardest one is then refined between them,
    which may fail or cost impulse; the search ends when the hardest one is a refined one.
    """
    found, refined, k = dict[int, Solution](), set[int](), 0

    def tried(k: int, **start: Any) -> None:
        found.pop(k, None)
        with warnings.catch_warnings(), contextlib.suppress(InputError):
            warnings.simplefilter("ignore")  # a failed trial is no result
            solution = solve(problem_of(k), options=TRIAL, refine=bool(start), **start)
            if solution.status.usable:
                found[k] = solution

    while found or k < len(strong):
        best = max(found, key=lambda k: _worth(found[k]), default=None)
        enough = len(found) == MAX_MOTIONS or k == len(strong)
        if best is not None and (enough or strong[k].objective < WORTH_A_PLAN * _worth(found[best])):
            if best in refined:
                return best, _worth(found[best])
            refined.add(best)
            tried(best, start=found[best])
        else:
            say(f"planning the motion to strike {k + 1} of {len(strong)}")
            tried(k)
            k += 1
    return None


def _worth(solution: Solution) -> float:
    return sum(solution.objectives.values())


def _strike_message(strong: list[Strong], best: tuple[int, float] | None, *, tried: bool) -> str:
    """Message about the drafted strike; best : of `_hardest_planned`, if that was `tried`."""
    k, objective = best or (0, strong[0].objective)
    normal = ", ".join(f"{x:.3g}" for x in strong[k].normal)
    with_motion = " that have a whole motion" if best else ""
    # a motion is planned from one initial guess, and its strike does not show what others would find
    after = "; `solve --starts 8` may find a harder motion" if best else ""
    if tried and not best:
        after = "; no whole motion to it, or to another one, was found"
    return (
        f"the drafted strike, along [{normal}] ({_in_words(strong[k].normal)}), is the hardest of those "
        f"tried{with_motion}: {objective:.3g} {strong[k].unit}{after}"
    )


def _in_words(direction: Array) -> str:
    """Direction (3,) in words, such as "ahead and down"."""
    words = (("ahead", "back"), ("to the left", "to the right"), ("up", "down"))
    named = zip(direction, words, strict=True)
    return " and ".join(pair[int(x < 0)] for x, pair in named if abs(x) > SLIGHT)


def _arms(drafted: Drafted) -> tuple[list[Arm], list[Striker]]:
    """Arms that may strike, right or longest first; and all strikers."""
    model, limbs = drafted.robot.model, drafted.arms
    names = sides(model, [limb.tip for limb in limbs])
    names = [f"{name}_hand" if name in ("left", "right") else name for name in names]
    names = ["hand"] if len(names) == 1 else names
    arms, strikers = [], []
    for limb, name in zip(limbs, names, strict=True):
        tip = (*drafted.pieces.get(limb.tip, ()), *seen_pieces(drafted.robot, limb.tip))
        striker, axis = find_striker(model, limb, name, {limb.tip: tip})
        arms.append(Arm(limb=limb, name=name, axis=axis))
        strikers.append(striker)
    arms.sort(key=lambda arm: (not arm.name.startswith("right"), -len(arm.limb.own)))
    return arms, strikers


def _data(case: _Case, robot: Robot, q: Array) -> dict[str, Any]:
    """Data of a problem file with a robot in its start posture q (nq,), without a hit point."""
    drafted, soles, options = case.drafted, case.soles, case.drafted.options
    keys: dict[str, Any] = {
        drafted.kind.lower(): relative_path(drafted.path, case.folder),
        "name": robot.name,
    }
    if "floating" in options:
        keys["floating"] = options["floating"]
    for option in ("locked", "armature", "torque_limit", "velocity_limit", "position_limit"):
        if options.get(option):
            keys[ROBOT_KEYS[option]] = dict(options[option])
    if soles:
        keys["soles"] = [sole_data(sole) for sole in soles]
    keys["strikers"] = [section_data(StrikerSection, striker) for striker in case.strikers]
    keys |= {"tools": [section_data(ToolSection, tool) for tool in robot.tools]} if robot.tools else {}
    keys["postures_rad"] = {START: _angles(robot, q)}
    mass = sum(float(body.mass) for body in robot.model.inertias)
    data: dict[str, Any] = {
        "problem": {"name": f"first strike of {robot.name}", "start": START},
        "robot": keys,
        **hits(None, robot)[0].data,
        "swing": {"duration_s": list(SWING), "intervals": 16 if soles else 12},
        "follow": {"duration_s": list(FOLLOW), "intervals": 14 if soles else 10},
    }
    if soles:
        part = mass / 90.0  # scales bounds that suit TALOS, with 90 kg on soles 12 cm wide
        width = min(float(np.ptp(sole.polygon, axis=0).min()) for sole in soles)
        margin = round(float(np.clip(0.15 * width, 0.005, 0.02)), 3)
        data["terms"] = {
            "contact_wrench_cone": {
                "margin_m": margin,
                "collision_margin_m": margin,
                "minimum_force_N": float(f"{50 * part:.2g}"),
            },
            "balance": {"angular_momentum_N_m_s": float(f"{min(10.0, 10 * part):.2g}")},
        }
    if known := published_limits(robot.joint_names):
        acceleration, jerk = (
            dict(zip(known.joints, of, strict=True)) for of in (known.acceleration, known.jerk)
        )
        data.setdefault("terms", {})["joint_acceleration"] = {"limit_rad_s2": acceleration}
        data["terms"]["joint_jerk"] = {"limit_rad_s3": jerk}
    return plain_value(data)


def _angles(robot: Robot, q: Array) -> dict[str, float]:
    """Angles of a configuration (nq,) by joint, for a file."""
    angles = zip(robot.joint_names, robot.joint_positions(q), robot.hinges, strict=True)
    return {joint: round(float(x), 5) for joint, x, hinge in angles if not hinge}


def _aimed(
    data: dict[str, Any], striker: str, points: Iterator[Array], way: Array, folder: Path
) -> tuple[dict[str, Any], ImpactProblem]:
    """The data with the first hit point for which the checks of a problem pass, and the problem.

    Raises
    ------
    InputError : there is none; with the mistake of the first.
    """
    first = ""
    for k, point in enumerate(points):
        if k == MAX_TARGETS:
            break
        normal = (np.round(way, 9) + 0.0).tolist()
        problem = {"striker": striker, "point_m": point.tolist(), "normal": normal, "start": START}
        if AT_CONTACT in data["robot"]["postures_rad"]:
            problem["near_contact"] = AT_CONTACT
        aimed = {**data, "problem": {"name": data["problem"]["name"], **problem}}
        try:
            built = _built(aimed, folder)
            wrong = hopeless(built)
            if not wrong and touches(built, built.start_posture):
                wrong = ["bodies touch at the start"]
        except InputError as error:
            wrong = [str(error)]
        if not wrong:
            return aimed, built
        first = first or wrong[0]
    posture, remedy = "the drafted posture", "write the problem file by hand (docs/howto/robot.md)"
    if way[2] < 0:
        posture += " and from above, as drafted nails and boards are"
        remedy = (
            "draft it without --motion, and give that file [target] and [contact] of `impactopt new "
            "arm_planar` (a nail) or `chop_arm` (a board), with resistance_N or breaking_force_N of some "
            f"{FORCE_PER_MASS:g} N for each kg of the robot"
        )
    raise InputError(
        f"no target is found that {striker!r} can hit from {posture}; {remedy}{f': {first}' if first else ''}"
    )


def _built(data: dict[str, Any], folder: Path) -> ImpactProblem:
    """The problem of drafted data, with repaired inertias."""
    tried = {**data, "robot": {**data["robot"], "inertias": REPAIRED}}
    return ProblemFile.from_data(tried, folder / "draft.toml").build()


def _text(data: dict[str, Any], drafted: Drafted, robot: Robot) -> str:
    """Text of the problem file, with comments on guesses."""
    guessed = {
        "armature_kg_m2": f"{DOUBT}: {1e3 * USUAL_ROTOR:g} g m2 per N m, or more for the file's servo gains; "
        "give rotor inertia x gear^2",
        "torque_limit_N_m": f"{DOUBT}: from the largest gravity torques; the file has no plausible one",
        "velocity_limit_rad_s": f"{DOUBT}; the file has no plausible one",
        "position_limit_rad": f"{DOUBT}; the file has no plausible one",
        "soles": "found in the feet's collision shapes: the part within 5 mm of the ground",
        "strikers": "found at the ends of the last links' shapes; move them to the striking points",
        "tools": f"{DOUBT}: a peg to be mounted, as the links before it would touch the target first",
        "locked_rad": "; ".join(_reasons(drafted.locked)),
    }

    known = published_limits(robot.joint_names)

    def comment(place: Place) -> str:
        if len(place) == 2 and place[0] == "robot" and str(place[1]) in guessed:
            return guessed[str(place[1])]
        if place == ("robot", "postures_rad", START):
            return "soles level, knees forward, arms bent" if data["robot"].get("soles") else "bent"
        if place == ("robot", "postures_rad", AT_CONTACT):
            return "of the strike for which the target is placed"
        if place == ("problem", "normal"):
            return f"{comment_at(data, place)}: {_in_words(np.array(data['problem']['normal']))}"
        if known and place in (("terms", "joint_acceleration"), ("terms", "joint_jerk")):
            return f"limits of its controller ({known.source}); leave them out for torque control"
        return comment_at(data, place)

    def hidden(place: Place) -> Mapping[str, Any]:
        return {"inertias": REPAIRED} if place == ("robot",) and drafted.wrong else {}

    head = [
        f"# A first strike of {robot.name}, drafted by `impactopt new`.",
        f"# {DOUBT} marks numbers to replace by the manufacturer's. `impactopt check FILE` finds mistakes.",
    ]
    if _guessed_gains(robot).any():
        head.append(f"# Servo gains, kp and kd, are {DOUBT}: give those of your servos in [robot].")
    for text in drafted.drives.said:
        head.append(f"# {text}.")
    if drafted.wrong:
        head += [
            f"# {_wrong(drafted)}. Correct the {drafted.kind}, or remove "
            'the # before `inertias = "repaired"`:',
            *(f"#   {text.partition('; correct')[0]}" for text in drafted.wrong),
        ]
    text = write_toml(data, comment, hidden).rstrip("\n")
    return "\n".join([*head, "", text, "", *_frames(robot), ""])


def _reasons(locked: Mapping[str, str]) -> Iterator[str]:
    """Reasons for locked joints, each once with its joint or their count."""
    for reason in dict.fromkeys(locked.values()):
        names = [name for name, other in locked.items() if other == reason]
        yield f"{reason} ({names[0] if len(names) == 1 else counted(len(names), 'joint')})"


def _frames(robot: Robot) -> Iterator[str]:
    """Comments with the frames for soles and strikers."""
    yield "# Frames for other strikers and soles, by the joint that moves them:"
    model = robot.model
    for joint in range(1, model.njoints):
        frames = [f for f in model.frames if f.parentJoint == joint and f.type != pin.FrameType.JOINT]
        names = [str(f.name) for f in frames if not str(f.name).startswith(("striker:", "sole:"))]
        if names:
            yield f"#   {model.names[joint]}: {', '.join(names)}"


def _messages(data: Mapping[str, Any], drafted: Drafted, robot: Robot) -> Iterator[str]:
    """Messages for the user before the first plan."""
    stands = "on two legs" if drafted.legs else "on a fixed base"
    joints, striker = robot.n - int(robot.hinges.sum()), data["problem"]["striker"]
    yield f"{robot.name}: {joints} joints, {stands}; {striker!r} strikes"
    if drafted.freed:
        yield "the MJCF has no free joint: it stands on its two legs here; --bolted leaves it bolted"
    if drafted.fixed:
        yield (
            "the MJCF's free joint is taken out: no two legs are found below its root, z up, with all joints "
            "at zero"
        )
    if drafted.turn:
        yield TURNED.format(drafted.turn)
    across = [sole["name"] for sole in data["robot"].get("soles", ()) if _wide(sole["polygon_m"])]
    if across:
        yield f"soles that are longer across than ahead: {', '.join(across)}; look at the feet's shapes"
    for sole in robot.soles:
        if sole.hinge is not None:
            yield (
                f"sole {sole.name!r} has a leg of five joints: the foot may turn on it about {sole.hinge}, "
                f"by {sole.hinge_range:g} rad, and it transmits no moment about that axis"
            )
    yield from unit_doubts(robot)
    yield from shape_doubts(robot)
    if drafted.locked:
        yield f"locked: {'; '.join(_reasons(drafted.locked))}"
    yield from robot.source.notes if robot.source is not None else ()
    for key, what in (
        ("armature_kg_m2", "rotor inertias"),
        ("torque_limit_N_m", "torque limits"),
        ("velocity_limit_rad_s", "velocity limits"),
        ("position_limit_rad", "position limits"),
    ):
        if key in data["robot"]:
            of = f"{what} of {counted(len(data['robot'][key]), 'joint')}"
            yield f"guessed, as the {drafted.kind} has no plausible ones: {of}"
    if guessed := int(_guessed_gains(robot).sum()):
        yield (
            f"guessed: servo gains of {counted(guessed, 'joint')}, kd = 1.5 s x torque limit, at most 150, "
            "and kp = 30/s x kd; give kp_N_m_rad and kd_N_m_s_rad"
        )
    yield from drafted.drives.said[:3]
    if len(drafted.drives.said) > 3:
        yield f"... and {counted(len(drafted.drives.said) - 3, 'more such number')}: see the file's head"
    if drafted.wrong:
        them = "it" if len(drafted.wrong) == 1 else "them"
        yield (
            f"{_wrong(drafted)}, listed at the file's head: correct {them}, or "
            'set `inertias = "repaired"` there'
        )


def _wrong(drafted: Drafted) -> str:
    """Number of non-physical inertias in words."""
    return f"{counted(len(drafted.wrong), 'inertia is', 'inertias are')} not physical"


def _guessed_gains(robot: Robot) -> Mask:
    """Mask (n,) of joints whose gains are the defaults of a description without gains."""
    damping, stiffness = default_kd(robot.torque_limit), default_kp(robot.kd)
    return np.isclose(robot.kd, damping) & np.isclose(robot.kp, stiffness) & ~robot.hinges


def _wide(polygon: list[list[float]]) -> bool:
    """True if a sole is wider than long, which is implausible."""
    length, width = np.ptp(np.array(polygon), axis=0)
    return bool(width > length)
