"""One program from several starts: the problem has local optima, and the best of them is kept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_array, did_you_mean
from impactopt.planning.stopping import Stop
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import (
    Callback,
    IterationRecord,
    NonlinearProgram,
    SolverResult,
    Status,
    Violation,
    worst_rows,
)
from impactopt.solvers.run import Path, Watch
from impactopt.solvers.sqp import SQPOptions, solve_sqp
from impactopt.transcription.initial_guess import carried_over

if TYPE_CHECKING:
    from impactopt.transcription.contact_program import ContactProgram

Array = NDArray[np.float64]
Program = TypeVar("Program", bound="ContactProgram")
Starts = Iterable[tuple[str, Callable[[], Array | SolverResult]]]
SOLVERS = ("sqp", "ipopt")
EFFORT = ("iterations", "seconds", "seconds_functions", "seconds_qp")
VIOLATED = 1e-4  # larger violations are named; an iterate without any is a solution, if not an optimum
NAMED = 20  # at most
_PUSH = 1e-6  # into its bounds, of a start that is to stay where it is
SPEEDS, NOISE = (0.5, 3.0), (0.05, 0.5)  # [m/s], [rad] that the starts beside the plain one are drawn from


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """Result of the solve from one initial guess.

    start : its name; impulse [N s]; seconds: of the solver; kept: it is the one that was best.
    """

    start: str
    status: Status
    impulse: float
    objective: float
    max_violation: float
    iterations: int
    seconds: float
    kept: bool = False

    def summary(self) -> dict[str, Any]:
        """JSON form, as it stands in ``summary.json``."""
        return {
            "start": self.start,
            "status": self.status.value,
            "impulse_Ns": self.impulse,
            "objective": self.objective,
            "max_violation": self.max_violation,
            "iterations": self.iterations,
            "seconds": self.seconds,
            "kept": self.kept,
        }


@dataclass(frozen=True, kw_only=True)
class Budget:
    """A solver with its options, and the time [s] that is left for all that it is given; None: any.

    stop : what Ctrl-C asks.

    Raises
    ------
    InputError : an unknown solver; a time that is none; options that the SQP does not have (IPOPT is asked
        about its own when it starts).
    """

    solver: str
    options: Mapping[str, Any] | None
    time_limit: float | None
    callback: Callback | None
    since: float = field(default_factory=time.perf_counter)
    stop: Stop = field(default_factory=Stop)

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise InputError(
                f"unknown solver {self.solver!r}{did_you_mean(self.solver, SOLVERS)}: there are "
                f"{', '.join(SOLVERS)}"
            )
        if self.time_limit is not None and not check_array("time_limit [s]", self.time_limit, ()) > 0:
            raise InputError(f"time_limit [s]: {self.time_limit:g}; give a number > 0")
        if self.options is None:
            return
        if not isinstance(self.options, Mapping) or not all(isinstance(name, str) for name in self.options):
            raise InputError(f"options are those of the solver by name, not {self.options!r}")
        if self.solver == "sqp":
            known = [f.name for f in fields(SQPOptions)]
            for name in self.options:
                if name not in known:
                    raise InputError(
                        f"the solver 'sqp' has no option {name!r}{did_you_mean(name, known)}; it has "
                        f"{', '.join(known)}"
                    )
            SQPOptions(**self.options)

    def started(self) -> Budget:
        """The same with all its time, which begins now; from here on an iterate is kept if it is stopped."""
        self.stop.armed = True
        return replace(self, since=time.perf_counter())

    def near_by(self) -> Budget:
        """The same, whose solver hardly moves a start off its bounds: it is a solution, or next to one, and
        what is moved may come to another.
        """
        return (
            replace(self, options={"push": _PUSH, **(self.options or {})}) if self.solver == "sqp" else self
        )

    @property
    def interior(self) -> bool:
        """True if the solver is the interior-point method."""
        return self.solver == "sqp" and (self.options or {}).get("qp_solver", "interior") == "interior"

    @property
    def left(self) -> float | None:
        """[s]; none where it has been stopped."""
        if self.stop.asked:
            return 0.0
        if self.time_limit is None:
            return None
        return max(self.time_limit - (time.perf_counter() - self.since), 0.0)

    def _told(self, record: IterationRecord) -> bool:
        """Reports an iteration to the caller; true if the solver is to stop after it."""
        asked = self.callback is not None and self.callback(record) is True
        return asked or self.stop.asked

    def run(
        self,
        program: NonlinearProgram,
        start: Array | SolverResult,
        barrier: float | None = None,
        most: int | None = None,
        watch: Watch | None = None,
        *,
        path: Path | None = None,
    ) -> SolverResult:
        """Let the solver work on a program in the time that is left.

        start : variables (n,); or a neighbouring program's result, whose multipliers "sqp" takes too.
        barrier : the first of "sqp" from a result, where that is not as near as it looks.
        most : iterations of "sqp", if the options do not say how many.
        watch, path : as of `solve_sqp`, of the interior-point method.
        """
        left, y, z = None if self.stop.asked else self.left, None, None
        if isinstance(start, SolverResult):
            x0, y, z = start.x, start.multipliers, start.bound_multipliers
        else:
            x0 = start
        if self.solver == "ipopt":
            return solve_ipopt(program, x0, options=self.options, callback=self._told, time_limit=left)
        settings = dict(self.options or {})
        if most is not None:
            settings.setdefault("max_iterations", most)
        if barrier is not None and z is not None:
            settings.setdefault("barrier_warm", barrier)
        if left is not None:
            settings["time_limit"] = max(left, 1e-9)
        return solve_sqp(
            program,
            x0,
            options=SQPOptions(**settings),
            callback=self._told,
            multipliers=y,
            bound_multipliers=z,
            watch=watch if self.interior else None,
            path=path,
        )


def check_starts(starts: int, seed: int, *, given: bool) -> None:
    """InputError if these are no number of starts, or no seed; ``given``: the one start is given."""
    for name, value, least in (("starts", starts, 1), ("seed", seed, 0)):
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
            raise InputError(f"{name} is {value!r}; give a whole number >= {least}")
    if given and starts > 1:
        raise InputError(f"starts is {starts}, of one start that is given; leave one of the two out")


def drawn(starts: int, seed: int) -> list[dict[str, Any]]:
    """Speed, noise and seed of each start's reach; the first one is the plain reach."""
    rng = np.random.default_rng(seed)
    others = [
        {
            "speed": float(rng.uniform(*SPEEDS)),
            "noise": float(rng.uniform(*NOISE)),
            "seed": int(rng.integers(2**31)),
        }
        for _ in range(starts - 1)
    ]
    return [{}, *others]


def solve_from(
    t: Program,
    starts: Starts,
    budget: Budget,
    began: float,
    work: Callable[[Program, Array | SolverResult], tuple[Program, SolverResult]] | None = None,
) -> tuple[Program, dict[str, Any]]:
    """The program of the best result from these starts, and the fields of its
    :class:`impactopt.planning.solution.Solved`.

    starts : name, and what makes its x (n,) when its turn comes. An interrupted solve is the last one, and so
    is one after which no time is left.  began [s] : when work on the problem did.
    work : what is done from a start; None: the program is solved as it is. It may end with another program.

    Of those that meet their constraints the one of least objective is best, else the one of least violation.
    """
    built = time.perf_counter()
    found, attempts = list[tuple[Program, SolverResult]](), list[Attempt]()
    for name, make in starts:
        start = make()
        program, result = (t, budget.run(t.program, start)) if work is None else work(t, start)
        found.append((program, result))
        attempts.append(attempt_of(program, name, result))
        if result.status is Status.INTERRUPTED or budget.left == 0:
            break
    order = [rank_of(result) for _, result in found]
    best = order.index(min(order))
    attempts[best] = replace(attempts[best], kept=True)
    t, result = found[best]
    solved, rows = time.perf_counter(), t.program.constraints(result.x)
    return t, {
        "problem": t.problem,
        "result": result,
        "solver": budget.solver,
        "build_seconds": built - began,
        "solve_seconds": solved - built,
        "violations": violations_of(t, result.x, rows),
        "objectives": t.achieved(result.x),
        "attempts": tuple(attempts),
    }


def attempt_of(t: ContactProgram, name: str, result: SolverResult) -> Attempt:
    """Result of the solve, or of the refinement round, of that name."""
    return Attempt(
        start=name,
        status=result.status,
        impulse=t.impulse(result.x),
        objective=result.objective,
        max_violation=result.max_violation,
        iterations=result.iterations,
        seconds=result.seconds,
    )


def violations_of(t: ContactProgram, x: Array, rows: Array) -> tuple[Violation, ...]:
    """Violated constraints at solver variables (n,), worst first; their values are ``rows`` (m,)."""
    return tuple(worst_rows(t.program, x, rows, tolerance=VIOLATED, count=NAMED))


def rank_of(result: SolverResult) -> tuple[bool, float]:
    """Less is better: those that meet their constraints by their objective, then the others by their
    violation.
    """
    met = result.status.usable or result.max_violation <= VIOLATED
    return not met, result.objective if met else result.max_violation


def one_after_the_other(old: SolverResult, new: SolverResult) -> SolverResult:
    """The new result, with the effort of both."""
    later = tuple(
        replace(r, iteration=old.iterations + r.iteration, seconds=old.seconds + r.seconds)
        for r in new.history
    )
    effort = {key: getattr(old, key) + getattr(new, key) for key in EFFORT}
    return replace(new, history=old.history + later, **effort)


def with_effort_of(kept: SolverResult, last: SolverResult) -> SolverResult:
    """A result that an earlier round had, with the effort until the last one."""
    return replace(kept, history=last.history, **{key: getattr(last, key) for key in EFFORT})


def carried(new: ContactProgram, old: ContactProgram, result: SolverResult) -> SolverResult:
    """A program's result as the start of another, see `carried_over`."""
    if new is old:
        return result
    x, y, z = carried_over(new, old, result.x, result.multipliers, result.bound_multipliers)
    return replace(result, x=x, multipliers=y, bound_multipliers=z)


def touching(result: SolverResult, depth: float, names: Iterable[str], what: str) -> SolverResult:
    """A result whose bodies penetrate by so much [m]: no solution.  names : of the pairs of bodies.

    Where nothing else is found it is still told, but goes before no start that is clean.
    """
    pairs = "; ".join(sorted(set(names))[:3])
    found = f"no {what} was found in which they do not"
    message = f"Bodies penetrate each other by {1e3 * depth:.1f} mm, and {found}: {pairs}."
    worst = max(result.max_violation, depth, 2 * VIOLATED)
    return replace(result, status=Status.FAILED, max_violation=worst, message=message)
