"""Solver call in the time that is left, and what its results are compared by."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt.errors import InputError, check_choice, check_positive
from impactopt.solvers.ipm import IPMOptions, solve_ipm
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.options import OPTIONS
from impactopt.solvers.program import Callback, IterationRecord, NonlinearProgram, SolverResult, Status
from impactopt.solvers.run import Path, Watch
from impactopt.solvers.sqp import SQPOptions, solve_sqp

Array = NDArray[np.float64]
SOLVERS = (*OPTIONS, "ipopt")
EFFORT = ("iterations", "seconds", "seconds_functions", "seconds_qp")
VIOLATED = 1e-4  # larger violations are named; an iterate without any is a solution, if not an optimum
_PUSH = 1e-6  # into its bounds, of a start that is to stay where it is


class Stop:
    """Flag by which a signal ends the work at its next step.

    armed : whether there is something to keep. Until then, and the second time, a signal raises
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
    """A `Stop` for SIGINT, and for SIGTERM where that raises KeyboardInterrupt too, as in commands.

    Handlers of a caller's own stay, and so do those of threads that are not the main one. Within another one
    it is that one's.
    """
    main = threading.current_thread() is threading.main_thread()
    numbers = [signal.SIGINT, signal.SIGTERM] if main else []
    for number in numbers:
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


@dataclass(frozen=True, kw_only=True)
class Budget:
    """A solver with its options, and the time [s] that is left for all that it is given; None: any.

    report : called with a line of text where work goes on.  stop : what Ctrl-C asks.

    Raises
    ------
    InputError : an unknown solver; a time that is none; options that the SQP does not have (IPOPT is asked
        about its own when it starts).
    """

    solver: str
    options: Mapping[str, Any] | None
    time_limit: float | None
    callback: Callback | None
    report: Callable[[str], None] | None = None
    since: float = field(default_factory=time.perf_counter)
    stop: Stop = field(default_factory=Stop)

    def __post_init__(self) -> None:
        check_choice("unknown solver", self.solver, SOLVERS)
        if self.time_limit is not None:
            check_positive("time_limit [s]", self.time_limit)
        if self.options is None:
            return
        if not isinstance(self.options, Mapping) or not all(isinstance(name, str) for name in self.options):
            raise InputError(f"options are those of the solver by name, not {self.options!r}")
        if kind := OPTIONS.get(self.solver):
            known = [f.name for f in fields(kind)]
            for name in self.options:
                check_choice(f"the solver {self.solver!r} has no option", name, known)
            kind(**self.options)

    def started(self) -> Budget:
        """The same with all its time, which begins now; from here on an iterate is kept if it is stopped."""
        self.stop.armed = True
        return replace(self, since=time.perf_counter())

    def near_by(self) -> Budget:
        """The same, whose solver hardly moves a start off its bounds: it is a solution, or next to one, and
        what is moved may come to another.
        """
        return replace(self, options={"push": _PUSH, **(self.options or {})}) if self.interior else self

    @property
    def interior(self) -> bool:
        """True if the solver is the interior-point method."""
        return self.solver == "ipm"

    @property
    def left(self) -> float | None:
        """[s]; none where it has been stopped."""
        if self.stop.asked:
            return 0.0
        if self.time_limit is None:
            return None
        return max(self.time_limit - (time.perf_counter() - self.since), 0.0)

    def say(self, text: str) -> None:
        """Reports a line of text."""
        if self.report is not None:
            self.report(text)

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

        start : variables (n,); or a neighbouring program's result, whose multipliers our solvers take too.
        barrier : the first of "ipm" from a result, where that is not as near as it looks.
        most : iterations of our solvers, if the options do not say how many.
        watch, path : as of `solve_ipm`.
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
        if left is not None:
            settings["time_limit"] = max(left, 1e-9)
        common: dict[str, Any] = {"callback": self._told, "multipliers": y, "bound_multipliers": z}
        if not self.interior:
            return solve_sqp(program, x0, options=SQPOptions(**settings), **common)
        if barrier is not None and z is not None:
            settings.setdefault("barrier_warm", barrier)
        return solve_ipm(program, x0, options=IPMOptions(**settings), watch=watch, path=path, **common)


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


def touching(result: SolverResult, depth: float, names: Iterable[str], what: str) -> SolverResult:
    """A result whose bodies penetrate by so much [m]: no solution.  names : of the pairs of bodies.

    Where nothing else is found it is still told, but goes before no start that is clean.
    """
    pairs = "; ".join(sorted(set(names))[:3])
    found = f"no {what} was found in which they do not"
    message = f"Bodies penetrate each other by {1e3 * depth:.1f} mm, and {found}: {pairs}."
    worst = max(result.max_violation, depth, 2 * VIOLATED)
    return replace(result, status=Status.FAILED, max_violation=worst, message=message)
