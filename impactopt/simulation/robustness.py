"""Does it stand, and hit, when the world is not quite as planned? Replays under drawn perturbations."""

from __future__ import annotations

import pickle
import re
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_array, check_positive, check_whole, shortened
from impactopt.problem.problem import ImpactProblem
from impactopt.robots.robot import Robot
from impactopt.simulation import Perturbation, Scene, Simulation, scene_of, simulate_mujoco
from impactopt.simulation.controller import ControllerSettings
from impactopt.simulation.engines import check_steps, with_step_error
from impactopt.simulation.mujoco_world import mujoco_module
from impactopt.simulation.workers import map_on_workers

__all__ = ["PerturbationRanges", "Robustness", "draw_perturbations", "robustness"]

Array = NDArray[np.float64]
Z95 = 1.959964  # of the normal distribution: 95 % lie within
STEP = 5e-4  # [s]: tells who stands as 1e-4 does, and costs a fifth
MOST_SEED = 10**9
MOST_DRAWS = 1_000_000  # each is a replay of a second
LOGARITHMIC = ("mass", "stiffness", "kp", "kd", "floor_time")  # half is as far from planned as twice


@dataclass(frozen=True, kw_only=True)
class PerturbationRanges:
    """Ranges (lower, upper) from which perturbations are drawn independently; see :class:`Perturbation`.

    mass, stiffness, kp, kd : factors, log-uniform.  floor_time [s] : the floor's time constant, log-uniform.
    distance [m], payload [kg], friction, torque_limit (a factor) : uniform.
    period [s] : sampling period of the servo, the same in every draw.

    Raises
    ------
    InputError : naming the range that is empty, or that has values that no perturbation can have.
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
                _changed(Perturbation(), {name: bound})  # refuses what is out of range
        Perturbation(period=self.period)

    def of(self, scene: Scene) -> PerturbationRanges:
        """These ranges, without factors of numbers that the scene's law or target does not have."""
        has = {"mass": scene.target.parameters, "stiffness": scene.law.parameters}
        none: dict[str, Any] = {name: (1.0, 1.0) for name, numbers in has.items() if name not in numbers}
        return replace(self, **none)

    def bounds(self) -> dict[str, tuple[float, float]]:
        """(lower, upper) by name, of what is drawn."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "period"}


def draw_perturbations(n: int, seed: int = 0, ranges: PerturbationRanges | None = None) -> list[Perturbation]:
    """n perturbations, drawn from ranges. With one seed, the first draws do not depend on n.

    Raises
    ------
    InputError : n is not at least 1, or the seed is negative.
    """
    n = check_whole("draws", n, least=1, most=MOST_DRAWS)
    seed = check_whole("seed", seed, least=0, most=2**63)
    if ranges is not None and not isinstance(ranges, PerturbationRanges):
        raise InputError(f"ranges: {shortened(repr(ranges))}; give PerturbationRanges")
    chosen = ranges if ranges is not None else PerturbationRanges()
    bounds = chosen.bounds()
    unit = np.random.default_rng(seed).random((n, len(bounds)))
    columns, planned = {}, Perturbation(period=chosen.period)
    for (name, (low, high)), u in zip(bounds.items(), unit.T, strict=True):
        value = low * (high / low) ** u if name in LOGARITHMIC else low + (high - low) * u
        columns[name] = np.clip(value, low, high)  # rounding does not leave the range
    return [_changed(planned, {name: float(value[k]) for name, value in columns.items()}) for k in range(n)]


def _changed(perturbation: Perturbation, numbers: dict[str, Any]) -> Perturbation:
    return replace(perturbation, **numbers)


class Row(NamedTuple):
    """Result of one replay: impulse [N s], largest slip and lift of a sole [m]; nan where it has none."""

    standing: bool
    reason: str
    impulse: float = np.nan
    slip: float = np.nan
    lift: float = np.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class Robustness:
    """Replays under n drawn perturbations.

    standing (n,); reason (n,): why a robot does not stand, or a replay has no result, "" else; impulse (n,)
    [N s]; slip, lift (n,) [m]: the most that a corner of a sole did; nan where a replay has no result.
    planned_impulse [N s].
    """

    perturbations: Sequence[Perturbation] = field(repr=False)
    drawn_from: PerturbationRanges
    standing: NDArray[np.bool_]
    reason: Sequence[str]
    impulse: Array
    slip: Array
    lift: Array
    planned_impulse: float

    @property
    def draws(self) -> int:
        return len(self.perturbations)

    @property
    def rate(self) -> float:
        """Share of the draws that stand; a replay without a result does not."""
        return float(np.mean(self.standing))

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the rate at which the plan stands under such perturbations."""
        n, p = self.draws, self.rate
        middle = (p + Z95**2 / (2 * n)) / (1 + Z95**2 / n)
        half = Z95 / (1 + Z95**2 / n) * np.sqrt(p * (1 - p) / n + Z95**2 / (4 * n**2))
        return max(0.0, float(middle - half)), min(1.0, float(middle + half))

    @property
    def impulse_mean(self) -> float:
        """[N s] of all draws, falls too; nan if no replay has a result."""
        known = self.impulse[np.isfinite(self.impulse)]
        return float(known.mean()) if known.size else float("nan")

    @property
    def impulse_std(self) -> float:
        """Standard deviation [N s] of the same draws' impulses."""
        known = self.impulse[np.isfinite(self.impulse)]
        return float(known.std()) if known.size else float("nan")

    def reasons(self) -> dict[str, int]:
        """Counts of each kind of reason, most frequent first; numbers in it are left out."""
        kinds = (re.sub(r"(?<= )[-+]?(\d[\d.e+-]*|nan|inf)(?=[ ,;:]|$)", "...", text) for text in self.reason)
        return dict(Counter(kind for kind in kinds if kind).most_common())

    def table(self) -> dict[str, Array]:
        """Drawn parameters, (n,) by name."""
        return {
            name: np.array([getattr(c, name) for c in self.perturbations])
            for name in self.drawn_from.bounds()
        }

    def separation(self) -> dict[str, dict[str, float]]:
        """Separation by parameter: its mean among draws that stand and that do not (of factors: the
        geometric mean), and the difference in standard deviations of the draws; nan where there are none.
        """
        out = {}
        for name, value in self.table().items():
            factor = name in LOGARITHMIC
            x = np.log(value) if factor else value
            stands, falls = (
                float(x[mask].mean()) if mask.any() else float("nan")
                for mask in (self.standing, ~self.standing)
            )
            spread = float(x.std())
            out[name] = {
                "stands": float(np.exp(stands)) if factor else stands,
                "falls": float(np.exp(falls)) if factor else falls,
                "apart": (falls - stands) / spread if spread > 0 else float("nan"),
            }
        return out

    def by_third(self) -> dict[str, list[float]]:
        """Fraction that stands of draws in the lower, middle and upper third of each parameter's range (of
        factors: of its logarithm), which means hide if draws fall at both ends; nan where there are none.
        """
        out = {}
        for name, value in self.table().items():
            low, high = self.drawn_from.bounds()[name]
            x, ends = (np.log(a) if name in LOGARITHMIC else a for a in (value, np.array([low, high])))
            width = max(float(ends[1] - ends[0]), np.finfo(float).tiny)
            third = np.clip(np.floor(3 * (x - ends[0]) / width), 0, 2)
            groups = [self.standing[third == k] for k in range(3)]
            out[name] = [float(g.mean()) if g.size else float("nan") for g in groups]
        return out


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Data that every replay needs."""

    robot: Robot
    reference: Any
    scene: Scene
    step: float
    controller: ControllerSettings | None = None


def _simulate(
    robot: Robot, reference: Any, scene: Scene, *, step: float = STEP, **options: Any
) -> Simulation:
    """Simulates a draw with the draws' own step, which the step's error is measured from."""
    return simulate_mujoco(robot, reference, scene, step=step, **options)


def replay(shared: Shared, perturbation: Perturbation) -> Row:
    """One draw; what goes wrong is its reason."""
    given = (shared.robot, shared.reference, shared.scene)
    controller = shared.controller
    if controller is not None:  # every draw has sensors of its own, whichever process replays it
        draw = zlib.crc32(repr(perturbation).encode())
        controller = replace(controller, seed=(controller.seed + draw) % MOST_SEED)
    try:
        options = {"step": shared.step, "perturbation": perturbation, "controller": controller}
        s = with_step_error(_simulate, *given, **options)
        check_steps(s, shared.step)
    except InputError as error:
        return Row(standing=False, reason=str(error))
    except Exception as error:  # whatever MuJoCo raises: other draws may still work
        return Row(standing=False, reason=f"{type(error).__name__}: {error}")
    moves = (float(m.max(initial=0.0)) for m in (s.slip, s.lift))
    return Row(bool(s.standing), s.fall or "", s.impulse, *moves)


def _crashed(code: int) -> Row:
    return Row(standing=False, reason=f"the process of the replay died (exit code {code})")


def _check_travels(scene: Scene) -> None:
    try:
        pickle.dumps((scene.law, scene.target))
    except Exception as error:  # as its kind is pickle's or Python's, by what is in the way
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
    """Replay a reference in MuJoCo, on free soles, under drawn perturbations.

    reference : as of :class:`impactopt.transcription.plan.Trajectory`.  planned_impulse [N s].
    draws, seed, ranges : as of :func:`draw_perturbations`; a wall has no mass, so none is drawn.
    workers : processes; the numbers do not depend on how many. A script that asks for more than 1 needs
        `if __name__ == "__main__":`.
    controller : settings of a whole-body controller; None: the joints' servo.
    step [s] : of the simulation; shorter where the impulse needs it, as of `validate`.
    progress : called with how many replays are done, of how many.

    A replay that diverges, whose steps leave more than 1 % of its impulse uncertain though they were halved,
    or whose process dies, is a draw that does not stand, with its reason. Ctrl-C ends the processes and is
    raised.

    Raises
    ------
    InputError : draws, seed, workers or step out of range; MuJoCo is not installed; the processes do not
        start, or a law or target of one's own cannot go to them.
    """
    scene = scene_of(problem)
    chosen = (ranges if ranges is not None else PerturbationRanges()).of(scene)
    perturbations = draw_perturbations(draws, seed, chosen)
    if workers < 1:
        raise InputError(f"{workers} workers; ask for at least 1")
    check_positive("step [s]", step)
    mujoco_module()
    if workers > 1:
        _check_travels(scene)
    shared = Shared(robot=problem.robot, reference=reference, scene=scene, step=step, controller=controller)
    rows = map_on_workers(replay, shared, perturbations, workers=workers, crashed=_crashed, progress=progress)
    return Robustness(
        perturbations=tuple(perturbations),
        drawn_from=chosen,
        standing=np.array([row.standing for row in rows]),
        reason=tuple(row.reason for row in rows),
        impulse=np.array([row.impulse for row in rows]),
        slip=np.array([row.slip for row in rows]),
        lift=np.array([row.lift for row in rows]),
        planned_impulse=float(planned_impulse),
    )
