"""Solver call with its options and the remaining time, and comparison of results."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from types import FrameType
from typing import Any

from impactopt.arrays import Array
from impactopt.errors import InputError, check_choice, check_positive, shortened
from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.options import OPTIONS
from impactopt.solvers.program import Callback, IterationRecord, NonlinearProgram, SolverResult, Status
from impactopt.solvers.run import BarrierState, Watch
from impactopt.solvers.sqp import SQPOptions, solve_sqp

SOLVERS = (*OPTIONS, "ipopt")
EFFORT = ("iterations", "seconds", "seconds_functions", "seconds_qp")
# Violations of the (scaled) constraints above it are listed. An iterate without any is feasible, if not an
# optimum.
VIOLATED = 1e-4
_PUSH = 1e-6  # distance that the solver keeps an initial guess from its bounds, if that is to stay as it is


class Stop:
    """Flag by which a signal ends the work at its next step.

    armed : whether there is an iterate to keep. Before that, and the second time, a signal raises
        KeyboardInterrupt at once.
    """

    def __init__(self) -> None:
        self.armed = self.asked = False

    def on_signal(self, _number: int, _frame: FrameType | None) -> None:
        """Handler of a signal that asks to end."""
        if self.asked or not self.armed:
            raise KeyboardInterrupt
        self.asked = True


@contextlib.contextmanager
def stopping() -> Iterator[Stop]:
    """Context with a `Stop` for SIGINT, and for SIGTERM if that raises KeyboardInterrupt too, as in commands.

    Handlers that the caller has set stay, as do all handlers if this is not the main thread. A nested context
    has the outer one's `Stop`.
    """
    main = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGINT, signal.SIGTERM] if main else []
    for number in numbers:
        # A handler that is a bound method of a Stop is that of an outer context.
        outer = getattr(signal.getsignal(number), "__self__", None)
        if isinstance(outer, Stop):
            yield outer
            return
    stop = Stop()
    mine = [n for n in numbers if signal.getsignal(n) is signal.default_int_handler]
    for number in mine:
        signal.signal(number, stop.on_signal)
    try:
        yield stop
    finally:
        for number in mine:
            signal.signal(number, signal.default_int_handler)


@dataclass
class Spent:
    """Number of iterations of all calls of a solver from one start."""

    iterations: int = 0


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Solver with its options, and the time limit [s] of all its calls together; None: no limit.

    The option `max_iterations`, if it is given, is the limit of all calls from one start together, or of each
    call if they are not `together`.

    callback : called with each iteration's record; True stops the solver.
    report : called with lines of text.
    since : when the time began (`time.perf_counter`).  stop : flag that Ctrl-C sets.
    spent : iterations of the present start.

    Raises
    ------
    InputError : an unknown solver; a time limit that is not positive; a callback or report that is no
        function; unknown options of our solvers (IPOPT checks its own when it starts).
    """

    solver: str
    options: Mapping[str, Any] | None
    time_limit: float | None
    callback: Callback | None
    report: Callable[[str], None] | None = None
    since: float = field(default_factory=time.perf_counter)
    stop: Stop = field(default_factory=Stop)
    spent: Spent = field(default_factory=Spent)
    together: bool = True

    def __post_init__(self) -> None:
        check_choice("unknown solver", self.solver, SOLVERS)
        if self.time_limit is not None:
            check_positive("time_limit [s]", self.time_limit)
        for name, given in (("callback", self.callback), ("report", self.report)):
            if given is not None and not callable(given):
                raise InputError(f"{name} must be a function, not {shortened(repr(given))}")
        if self.options is None:
            return
        if not isinstance(self.options, Mapping) or not all(isinstance(name, str) for name in self.options):
            raise InputError(f"options must be a mapping from names of solver options, not {self.options!r}")
        if kind := OPTIONS.get(self.solver):
            known = [f.name for f in fields(kind)]
            for name in self.options:
                check_choice(f"the solver {self.solver!r} has no option", name, known)
            # Only for its checks.
            kind(**self.options)

    def started(self) -> Budget:
        """Budget whose time begins now; from here on a stop keeps the best iterate."""
        self.stop.armed = True
        return replace(self, since=time.perf_counter())

    def begin_start(self) -> None:
        """Count iterations anew, for another start."""
        self.spent.iterations = 0

    def near_by(self) -> Budget:
        """Budget for an initial guess that is nearly a solution: the solver hardly moves it off its bounds,
        as from a moved one it may converge to another solution.
        """
        return replace(self, options={"push": _PUSH, **(self.options or {})}) if self.interior else self

    @property
    def interior(self) -> bool:
        """True if the solver is the interior-point method."""
        return self.solver == "ipm"

    @property
    def left(self) -> float | None:
        """Remaining time [s]; 0 after a stop, None without a limit."""
        if self.stop.asked:
            return 0.0
        if self.time_limit is None:
            return None
        return max(self.time_limit - (time.perf_counter() - self.since), 0.0)

    @property
    def iterations_left(self) -> int | None:
        """Remaining iterations of all calls together; None without such a limit."""
        given = (self.options or {}).get("max_iterations") if self.together else None
        return None if given is None else max(int(given) - self.spent.iterations, 0)

    def is_over(self) -> bool:
        """True if no time is left, or no iterations of this start."""
        return self.left == 0 or self.iterations_left == 0

    def say(self, text: str) -> None:
        """Reports a line of text."""
        if self.report is not None:
            self.report(text)

    def _on_iteration(self, record: IterationRecord) -> bool:
        """Callback of the solver: reports an iteration to the caller; True stops the solver."""
        stops = self.callback is not None and self.callback(record) is True
        return stops or self.stop.asked

    def run(
        self,
        program: NonlinearProgram,
        start: Array | SolverResult,
        barrier: float | None = None,
        most: int | None = None,
        watch: Watch | None = None,
        *,
        state: BarrierState | None = None,
    ) -> SolverResult:
        """Solve a program in the remaining time.

        start : initial guess (n,); or a similar program's result for a warm start, whose multipliers our
        solvers use too.
        barrier : first one of "ipm" for a warm start, if that is farther from the solution than it seems.
        most : largest number of iterations of our solvers, unless the options set it.
        watch, state : as of `solve_ipm`.
        """
        # After a stop the callback ends the solve at its first iterate; a limit of no
        # time would be a TIME_LIMIT.
        left, y, z = None if self.stop.asked else self.left, None, None
        if isinstance(start, SolverResult):
            x0, y, z = start.x, start.multipliers, start.bound_multipliers
        else:
            x0 = start
        if self.solver == "ipopt":
            return solve_ipopt(
                program, x0, options=self.options, callback=self._on_iteration, time_limit=left
            )
        settings = dict(self.options or {})
        if self.iterations_left is not None:
            settings["max_iterations"] = self.iterations_left
        elif most is not None:
            settings.setdefault("max_iterations", most)
        if left is not None:
            # The options refuse 0.
            settings["time_limit"] = max(left, 1e-9)
        common: dict[str, Any] = {"callback": self._on_iteration, "multipliers": y, "bound_multipliers": z}
        if self.interior:
            if barrier is not None and z is not None:
                settings.setdefault("barrier_warm", barrier)
            options = IPMOptions(**settings)
            result = solve_ipm(program, x0, options=options, watch=watch, state=state, **common)
        else:
            result = solve_sqp(
                program, x0, options=SQPOptions(**settings), watch=watch, state=state, **common
            )
        self.spent.iterations += result.iterations
        return result


def rank_of(result: SolverResult) -> tuple[bool, bool, float]:
    """Sorting key, best first: feasible results by their objective, those that a check has made acceptable
    after all others; then infeasible ones by their violation.
    """
    # Stopped solves count as feasible too, if they are.
    met = result.status.usable or result.max_violation <= VIOLATED
    # A check, as of clearances, has a message of its own; the solver's is of an iterate near an optimum.
    acceptable = Status.ACCEPTABLE
    doubted = result.status is acceptable and not result.message.startswith(acceptable.message)
    return not met, doubted, result.objective if met else result.max_violation


def one_after_the_other(old: SolverResult, new: SolverResult) -> SolverResult:
    """New result with the history and the effort of both."""
    later = tuple(
        replace(r, iteration=old.iterations + r.iteration, seconds=old.seconds + r.seconds)
        for r in new.history
    )
    effort = {key: getattr(old, key) + getattr(new, key) for key in EFFORT}
    return replace(new, history=old.history + later, **effort)


def with_effort_of(kept: SolverResult, last: SolverResult) -> SolverResult:
    """Result of an earlier round, with the history and the effort of the last one."""
    return replace(kept, history=last.history, **{key: getattr(last, key) for key in EFFORT})


def touching(result: SolverResult, depth: float, names: Iterable[str], what: str) -> SolverResult:
    """Failed result whose bodies penetrate each other by ``depth`` [m].

    names : of the pairs of bodies.  what : "solution" or "strike", for the message.
    The depth counts as a violation, so results without penetration rank before it (`rank_of`).
    """
    pairs = "; ".join(sorted(set(names))[:3])
    found = f"no {what} was found in which they do not"
    message = f"Bodies penetrate each other by {1e3 * depth:.2g} mm, and {found}: {pairs}."
    # Above VIOLATED however shallow, as `Outcome.refused` compares with it.
    worst = max(result.max_violation, depth, 2 * VIOLATED)
    return replace(result, status=Status.FAILED, max_violation=worst, message=message)
