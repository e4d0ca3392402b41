"""Replays of a small plan against an equation of their own: within 1 % of the impulse, or refused.

Pinocchio's mass matrix and bias, the servo, laws and targets written out again, and SciPy's Radau from switch
to switch, which follows targets of a milligram behind steel as it follows walls.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from fuzz.attack_cases import Generator, pick
from fuzz.attack_equation import StruckTarget, Unjudged, force_of, switch_of
from impactopt.contact import (
    Board,
    FreeMass,
    HertzDamped,
    HuntCrossley,
    KelvinVoigt,
    Nail,
    RigidWall,
    SpringDamper,
)
from impactopt.errors import InputError
from impactopt.files.replay import Planned, load_planned
from impactopt.simulation import scene_of
from impactopt.simulation.collision_geometry import Solids
from impactopt.simulation.engines import ALLOWED, ENGINES, check_steps, with_step_error

Array = NDArray[np.float64]

LIGHTEST = 1.35e-6  # [kg] that has been seen to go wrong: every eighth target has it
FACE = 0.2  # [m] about the hit point in which there is something to hit
_MASS = 0.5  # [kg] of the arm at its hammer, about
_MOST_PIECES, _MOST_SLOPES = 4000, 300_000


@dataclass(frozen=True, kw_only=True)
class Replayed:
    """How many replays were judged, off by more than 1 %, refused, too slow to judge; what was off, in words;
    the largest error of those that were not, relative."""

    replays: int = 0
    off: int = 0
    refused: int = 0
    unjudged: int = 0
    faults: tuple[str, ...] = field(default=())
    largest: float = 0.0


def replay_one(result: Path, seed: int, number: int) -> Replayed:
    """A saved plan whose law and target are drawn, replayed by both engines."""
    planned = load_planned(result)
    law, target = drawn(np.random.default_rng([seed, 5, number]))
    what = f"{law!r}, {target!r} (seed {seed}, number {number})"
    found: dict[str, float] = {}
    refused = 0
    # bodies that touch each other are no part of the equation
    scene = replace(scene_of(planned.problem), law=law, target=target, solids=Solids())
    for name, engine in ENGINES.items():
        try:
            given = (planned.problem.robot, planned.reference, scene)
            replayed = with_step_error(engine, *given, settle=0.0)
            check_steps(replayed, None)
            found[name] = replayed.impulse
        except InputError:
            refused += 1
    if not found:
        return Replayed(replays=refused, refused=refused)
    try:
        true = follow(planned, law, target)
    except Unjudged:
        return Replayed(unjudged=len(found), refused=refused, replays=refused)
    size = max(true, np.finfo(float).tiny)
    errors = {name: abs(x - true) / size for name, x in found.items()}
    off = {name: e for name, e in errors.items() if not e <= ALLOWED}
    told = ", ".join(f"{name} {found[name]:.6g} for {true:.6g} N s" for name in off)
    return Replayed(
        replays=len(found) + refused,
        off=len(off),
        refused=refused,
        faults=(f"{what}: {told}",) if off else (),
        largest=max((e for e in errors.values() if e <= ALLOWED), default=0.0),
    )


def drawn(rng: Generator) -> tuple[Any, Any]:
    """A law, 1e4 to 1e8 N/m at a millimetre, and a target of 1e-5 to 1e4 kg."""
    mass = 10 ** rng.uniform(-5, 4) if rng.random() > 0.125 else LIGHTEST
    kind = pick(rng, ("mass", "mass", "mass", "nail", "board", "wall"))
    target: Any = FreeMass(mass=mass)
    if kind == "nail":
        mass = min(mass, 1.0)
        target = Nail(mass=mass, resistance=10 ** rng.uniform(2, 3), hardening=10 ** rng.uniform(3, 5))
    elif kind == "board":
        mass = float(np.clip(mass, 1e-2, 10.0))
        target = Board(mass=mass, stiffness=1e5, breaking_force=10 ** rng.uniform(2, 3.5), damping=10.0)
    elif kind == "wall":
        mass, target = np.inf, RigidWall()
    k = 10 ** rng.uniform(4, 8)
    damping = 2 * rng.uniform(0, 0.6) * float(np.sqrt(k / (1 / _MASS + 1 / mass)))
    dissipation = rng.uniform(0, 0.6)
    law = pick(
        rng,
        (
            SpringDamper(stiffness=k, damping=damping),
            KelvinVoigt(stiffness=k, damping=damping),
            HuntCrossley(stiffness=k * 30, dissipation=dissipation),
            HertzDamped(stiffness=k * 30, damping=damping),
        ),
    )
    return law, target


def follow(planned: Planned, law: Any, target: Any) -> float:
    """Impulse [N s] of an arm on a fixed base that follows a plan, up to its end.

    Raises
    ------
    Unjudged : it would take minutes, or the hand leaves the face of what it hits.
    """
    problem, r = planned.problem, planned.reference
    robot = problem.robot
    model, data, n = robot.model, robot.model.createData(), robot.n
    hand = model.getFrameId(robot.striker(problem.striker).model_frame)
    point, normal = np.asarray(problem.point), np.asarray(problem.normal)
    rows = np.hstack([r.q, r.v, r.torque])
    p = {f"contact_{name}": np.asarray(x) for name, x in law.parameters.items()}
    p |= {f"target_{name}": np.asarray(x) for name, x in target.parameters.items()}
    force, struck = force_of(law, p)[0], StruckTarget(target, p)
    inside, slopes = False, 0

    def at(q: Array) -> tuple[float, Array]:
        """How far the hand is along the normal, and its row of the Jacobian."""
        j = pin.computeFrameJacobian(model, data, q, hand, pin.LOCAL_WORLD_ALIGNED)
        way = pin.updateFramePlacement(model, data, hand).translation - point
        along = float(normal @ way)
        if inside and np.linalg.norm(way - along * normal) > FACE:
            raise Unjudged
        return along, normal @ np.array(j).reshape(6, n)[:3]

    def push(y: Array, row: Array) -> tuple[float, float]:
        """Rate of the depth, and force."""
        rate = float(row @ y[4 + n :]) - struck.speed(y)
        return rate, max(force(y[0], rate), 0.0) if inside else 0.0

    # depth, impulse, speed and travel of what is hit, angles and rates
    def flow(t: float, y: Array) -> Array:
        nonlocal slopes
        slopes += 1
        if slopes > _MOST_SLOPES:
            raise Unjudged
        q, v = y[4 : 4 + n], y[4 + n :]
        row = at(q)[1]
        rate, f = push(y, row)
        k = min(max(int(np.searchsorted(r.time, t, side="right")) - 1, 0), len(r.time) - 2)
        part = min((t - r.time[k]) / (r.time[k + 1] - r.time[k]), 1.0)
        now = (1 - part) * rows[k] + part * rows[k + 1]
        tau = now[2 * n :] + robot.kp * (now[:n] - q) + robot.kd * (now[n : 2 * n] - v)
        tau = np.clip(tau, -robot.torque_limit, robot.torque_limit)
        upper = np.triu(pin.crba(model, data, q))
        bias = pin.rnea(model, data, q, v, np.zeros(n))
        a = np.linalg.solve(upper + np.triu(upper, 1).T, tau - bias - row * f)
        return np.concatenate([[rate, f], struck.slope(y, f), v, a])

    size = np.repeat([1e-12, 1e-9, 1e-8, 1e-12, 1e-10, 1e-8], [1, 1, 1, 1, n, n])
    y = np.concatenate([[at(r.q[0])[0], 0.0, 0.0, 0.0], r.q[0], np.zeros(n)])
    t = 0.0
    jumps = r.time[1:][np.diff(r.time) == 0]
    ends = [*jumps[(jumps > 0) & (jumps < r.end)].tolist(), float(r.end)]
    for _ in range(_MOST_PIECES):
        struck.enter(y, push(y, at(y[4 : 4 + n])[1])[1])
        events = [
            switch_of(lambda t, y: float(y[0]), -1 if inside else 1),
            switch_of(lambda t, y: struck.switch(y, push(y, at(y[4 : 4 + n])[1])[1]), 0),
        ]
        # what comes after a jump holds from the jump on
        way = solve_ivp(
            flow, (t, np.nextafter(ends[0], 0.0)), y, method="Radau", rtol=1e-8, atol=size, events=events,
            first_step=min(1e-7, 0.5 * (ends[0] - t)),
        )  # fmt: skip
        t, y = float(way.t[-1]), way.y[:, -1].copy()
        if way.status < 0:
            raise Unjudged
        if way.status == 1:
            hit = [len(times) > 0 and times[-1] == t for times in way.t_events]
            inside = inside != hit[0]
            if hit[1]:
                struck.cross(y)
        if way.status == 0 or ends[0] - t < 1e-9:
            t = ends.pop(0)
            if not ends:
                return float(y[1])
    raise Unjudged
