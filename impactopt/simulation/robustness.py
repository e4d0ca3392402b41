"""Robustness of a plan: replays in MuJoCo under randomly drawn perturbations of the world."""

from __future__ import annotations

import pickle
import re
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from impactopt.arrays import Array, Mask
from impactopt.errors import InputError, check_array, check_positive, check_whole, shortened
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.robot import Robot
from impactopt.simulation import Perturbation, Scene, Simulation, scene_of, simulate_mujoco
from impactopt.simulation.controller import ControllerSettings
from impactopt.simulation.engines import check_steps, with_step_error
from impactopt.simulation.mujoco_world import mujoco_module
from impactopt.simulation.perturbation import MIN_PAYLOAD
from impactopt.simulation.workers import map_on_workers

Z95 = 1.959964  # 95 % of a normal distribution lie within as many standard deviations
STEP = 5e-4  # [s]: the same robots stand as with 1e-4, at a fifth of the time
MAX_SEED = 10**9
MAX_DRAWS = 1_000_000  # each is a replay of a second
LOGARITHMIC = ("mass", "stiffness", "kp", "kd", "floor_time")  # half is as far from planned as twice


@dataclass(frozen=True, kw_only=True)
class PerturbationRanges:
    """Ranges (lower, upper) from which perturbations are drawn independently; see :class:`Perturbation`.

    mass, stiffness, kp, kd : factors, log-uniform.  floor_time [s] : the floor's time constant, log-uniform.
    distance [m], payload [kg], friction, torque_limit (a factor) : uniform.
    period [s] : sampling period of the servo, the same in every draw.

    Raises
    ------
    InputError : a range is empty, or has values that no perturbation can have.
    """

    mass: tuple[float, float] = (0.5, 2.0)
    stiffness: tuple[float, float] = (0.3, 3.0)
    distance: tuple[float, float] = (-0.02, 0.02)
    payload: tuple[float, float] = (0.0, 1.0)
    friction: tuple[float, float] = (0.6, 1.0)
    kp: tuple[float, float] = (0.7, 1.4)
    kd: tuple[float, float] = (0.7, 1.4)
    torque_limit: tuple[float, float] = (0.85, 1.0)
    floor_time: tuple[float, float] = (1e-3, 6e-3)
    period: float = 1e-3

    def __post_init__(self) -> None:
        for name, bounds in self.bounds().items():
            low, high = check_array(f"ranges: {name}", bounds, (2,)).tolist()
            object.__setattr__(self, name, (low, high))
            if not low <= high:
                raise InputError(f"ranges: {name} is from {low:g} to {high:g}; give the lower bound first")
            if name in LOGARITHMIC and not low > 0:
                raise InputError(f"ranges: {name} starts at {low:g}; it is drawn by its logarithm: give > 0")
            for bound in (low, high):
                _changed(Perturbation(), {name: bound})  # raises an InputError if it is out of range
        Perturbation(period=self.period)

    def of(self, scene: Scene) -> PerturbationRanges:
        """Ranges without factors of parameters that the scene's law or target does not have."""
        known = {"mass": scene.target.parameters, "stiffness": scene.law.parameters}
        fixed: dict[str, Any] = {
            name: (1.0, 1.0) for name, parameters in known.items() if name not in parameters
        }
        return replace(self, **fixed)

    def bounds(self) -> dict[str, tuple[float, float]]:
        """Bounds (lower, upper) of the drawn parameters, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "period"}


def draw_perturbations(n: int, seed: int = 0, ranges: PerturbationRanges | None = None) -> list[Perturbation]:
    """Draws n perturbations from ranges. For a given seed, the first draws do not depend on n.

    Raises
    ------
    InputError : n is not at least 1, or the seed is negative.
    """
    n = check_whole("draws", n, least=1, most=MAX_DRAWS)
    seed = check_whole("seed", seed, least=0, most=2**63)
    if ranges is not None and not isinstance(ranges, PerturbationRanges):
        raise InputError(f"ranges: {shortened(repr(ranges))}; give PerturbationRanges")
    chosen = ranges if ranges is not None else PerturbationRanges()
    bounds = chosen.bounds()
    # row by row, so that the first draws are the same for any n
    unit = np.random.default_rng(seed).random((n, len(bounds)))
    columns, planned = {}, Perturbation(period=chosen.period)
    for (name, (low, high)), u in zip(bounds.items(), unit.T, strict=True):
        # log-uniform, or uniform
        value = low * (high / low) ** u if name in LOGARITHMIC else low + (high - low) * u
        columns[name] = np.clip(value, low, high)  # against rounding
    columns["payload"][columns["payload"] < MIN_PAYLOAD] = 0.0
    return [_changed(planned, {name: float(value[k]) for name, value in columns.items()}) for k in range(n)]


def _changed(perturbation: Perturbation, values: dict[str, Any]) -> Perturbation:
    return replace(perturbation, **values)


class Outcome(NamedTuple):
    """Result of one replay: impulse [N s], largest slip and lift of a sole [m]; nan without a result."""

    standing: bool
    reason: str
    impulse: float = np.nan
    slip: float = np.nan
    lift: float = np.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class Robustness:
    """Results of replays under n drawn perturbations.

    standing (n,) : whether the robot stands at the end
    reason (n,) : why it does not, or why a replay has no result; else ""
    impulse (n,) [N s] : nan without a result
    slip, lift (n,) [m] : largest of all corners of soles; nan without a result
    planned_impulse [N s] : of the plan
    """

    perturbations: Sequence[Perturbation]
    drawn_from: PerturbationRanges
    standing: Mask
    reason: Sequence[str]
    impulse: Array
    slip: Array
    lift: Array
    planned_impulse: float

    def __repr__(self) -> str:
        """One line without arrays, which would fill pages."""
        return (
            f"<Robustness: {self.standing.sum()} of {self.draws} draws stand, {self.impulse_mean:.4g} N s of "
            f"{self.planned_impulse:.4g} planned>"
        )

    @property
    def draws(self) -> int:
        """Number of draws."""
        return len(self.perturbations)

    @property
    def rate(self) -> float:
        """Fraction of the draws that stand; a replay without a result counts as a fall."""
        return float(np.mean(self.standing))

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the rate at which the plan stands under such perturbations."""
        n, p = self.draws, self.rate
        # Wilson's, as that of the normal approximation has no width if all draws stand
        centre = (p + Z95**2 / (2 * n)) / (1 + Z95**2 / n)
        half = Z95 / (1 + Z95**2 / n) * np.sqrt(p * (1 - p) / n + Z95**2 / (4 * n**2))
        return max(0.0, float(centre - half)), min(1.0, float(centre + half))

    @property
    def impulse_mean(self) -> float:
        """Mean impulse [N s] of all draws, falls included; nan if no replay has a result."""
        known = self.impulse[np.isfinite(self.impulse)]
        return float(known.mean()) if known.size else float("nan")

    @property
    def impulse_std(self) -> float:
        """Standard deviation [N s] of the impulses of the same draws."""
        known = self.impulse[np.isfinite(self.impulse)]
        return float(known.std()) if known.size else float("nan")

    def reasons(self) -> dict[str, int]:
        """Counts of each kind of reason, most frequent first; numbers in a reason are replaced by "..."."""
        kinds = (re.sub(r"(?<= )[-+]?(\d[\d.e+-]*|nan|inf)(?=[ ,;:]|$)", "...", text) for text in self.reason)
        return dict(Counter(kind for kind in kinds if kind).most_common())

    def table(self) -> dict[str, Array]:
        """Drawn values (n,) of each parameter, by name."""
        return {
            name: np.array([getattr(c, name) for c in self.perturbations])
            for name in self.drawn_from.bounds()
        }

    def separation(self) -> dict[str, dict[str, float]]:
        """Separation of draws that stand from those that fall, by parameter.

        stands, falls : mean of the parameter among those draws; geometric for log-uniform parameters.
        apart : difference of the means in standard deviations of all draws.

        Values are nan without draws.
        """
        out = {}
        for name, value in self.table().items():
            logarithmic = name in LOGARITHMIC
            x = np.log(value) if logarithmic else value
            stands, falls = (
                float(x[mask].mean()) if mask.any() else float("nan")
                for mask in (self.standing, ~self.standing)
            )
            spread = float(x.std())
            out[name] = {
                "stands": float(np.exp(stands)) if logarithmic else stands,
                "falls": float(np.exp(falls)) if logarithmic else falls,
                "apart": (falls - stands) / spread if spread > 0 else float("nan"),
            }
        return out

    def by_third(self) -> dict[str, list[float]]:
        """Fraction of draws that stand in the lower, middle and upper third of each parameter's range.

        Thirds of log-uniform parameters are those of the logarithm. Unlike means, thirds show draws that fall
        at both ends of a range. A third without draws has nan.
        """
        out = {}
        for name, value in self.table().items():
            low, high = self.drawn_from.bounds()[name]
            x, ends = (np.log(a) if name in LOGARITHMIC else a for a in (value, np.array([low, high])))
            # an empty range has all draws in its first third
            width = max(float(ends[1] - ends[0]), np.finfo(float).tiny)
            third = np.clip(np.floor(3 * (x - ends[0]) / width), 0, 2)
            groups = [self.standing[third == k] for k in range(3)]
            out[name] = [float(g.mean()) if g.size else float("nan") for g in groups]
        return out


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Data shared by all replays."""

    robot: Robot
    reference: Any
    scene: Scene
    step: float
    controller: ControllerSettings | None = None


def _simulate(
    robot: Robot, reference: Any, scene: Scene, *, step: float = STEP, **options: Any
) -> Simulation:
    """`simulate_mujoco` with another default step, which `with_step_error` takes as the engine's own."""
    return simulate_mujoco(robot, reference, scene, step=step, **options)


def replay(shared: Shared, perturbation: Perturbation) -> Outcome:
    """Replays one draw; an error becomes its reason."""
    given = (shared.robot, shared.reference, shared.scene)
    controller = shared.controller
    if controller is not None:  # every draw has its own sensor errors, in whichever process it is replayed
        # `hash` of a text differs between processes
        draw = zlib.crc32(repr(perturbation).encode())
        controller = replace(controller, seed=(controller.seed + draw) % MAX_SEED)
    try:
        options = {"step": shared.step, "perturbation": perturbation, "controller": controller}
        s = with_step_error(_simulate, *given, **options)
        check_steps(s, shared.step)
    except InputError as error:
        return Outcome(standing=False, reason=str(error))
    except Exception as error:  # any error of MuJoCo: other draws may still work
        return Outcome(standing=False, reason=f"{type(error).__name__}: {error}")
    slip, lift = (float(m.max(initial=0.0)) for m in (s.slip, s.lift))
    return Outcome(bool(s.standing), s.fall or "", s.impulse, slip, lift)


def _crashed(code: int) -> Outcome:
    return Outcome(standing=False, reason=f"the process of the replay died (exit code {code})")


def _check_picklable(scene: Scene) -> None:
    """Raises an InputError if law or target cannot be sent to other processes."""
    try:
        pickle.dumps((scene.law, scene.target))
    except Exception as error:  # pickling raises errors of many classes
        raise InputError(
            f"the law or target cannot go to other processes ({error}); define its functions at the top of a "
            "module, no lambdas, or ask for workers=1"
        ) from error


def robustness(
    problem: ImpactProblem,
    reference: Any,
    planned_impulse: float,
    *,
    draws: int = 200,
    seed: int = 0,
    ranges: PerturbationRanges | None = None,
    workers: int = 2,
    step: float = STEP,
    controller: ControllerSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Robustness:
    """Replays a reference in MuJoCo, on free soles, under drawn perturbations.

    reference : as :class:`impactopt.transcription.plan.Trajectory`.  planned_impulse [N s] : of the plan.
    draws, seed, ranges : as in :func:`draw_perturbations`; a wall has no mass, so that none is drawn.
    workers : number of processes, on which results do not depend. A script that asks for more than 1 needs
        `if __name__ == "__main__":`.
    controller : settings of a whole-body controller, whose rate takes the place of the ranges' period; None:
        the joints' servo.
    step [s] : of the simulation; shorter where the impulse or the servo needs it, as in `validate`.
    progress : called with the number of finished replays, and of all.

    A replay that diverges, whose halved steps still leave more than 1 % of its impulse uncertain, or whose
    process dies, counts as a fall, with its reason. Ctrl-C ends the processes and is raised.

    Raises
    ------
    InputError : draws, seed, workers or step out of range; MuJoCo is not installed; the processes do not
        start, or a user's law or target cannot be sent to them.
    """
    scene = scene_of(problem)
    chosen = (ranges if ranges is not None else PerturbationRanges()).of(scene)
    if controller is not None:
        chosen = replace(chosen, period=0.0)
    perturbations = draw_perturbations(draws, seed, chosen)
    if workers < 1:
        raise InputError(f"{workers} workers; ask for at least 1")
    check_positive("step [s]", step)
    mujoco_module()
    if workers > 1:
        _check_picklable(scene)
    shared = Shared(robot=problem.robot, reference=reference, scene=scene, step=step, controller=controller)
    outcomes = map_on_workers(
        replay, shared, perturbations, workers=workers, crashed=_crashed, progress=progress
    )
    return Robustness(
        perturbations=tuple(perturbations),
        drawn_from=chosen,
        standing=np.array([one.standing for one in outcomes]),
        reason=tuple(one.reason for one in outcomes),
        impulse=np.array([one.impulse for one in outcomes]),
        slip=np.array([one.slip for one in outcomes]),
        lift=np.array([one.lift for one in outcomes]),
        planned_impulse=float(planned_impulse),
    )
