"""Requests of the live page: another hit point, other parameters; the latest one counts."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone

__all__ = ["LatestRequest", "Number", "PlanRequest", "numbers_of", "request_of"]

Request = TypeVar("Request")
Outcome = TypeVar("Outcome")


class LatestRequest(Generic[Request, Outcome]):
    """Answers requests one after the other. One that comes while another is worked on takes its place.

    work : from a request to its outcome. Its second argument says whether a newer request is there: then it
        may stop, as nobody will ask for what it returns.
    tell : is given each outcome that is still requested, or what the work raised, in the same thread.
    """

    def __init__(
        self,
        work: Callable[[Request, Callable[[], bool]], Outcome],
        tell: Callable[[Request, Outcome | Exception], object],
    ) -> None:
        self._work, self._tell = work, tell
        self._changed = threading.Condition()
        self._asked, self._answered, self._closed = 0, 0, False
        self._request: Request
        self._thread = threading.Thread(target=self._run, name="newest request", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Take this request in place of all before it."""
        with self._changed:
            self._request, self._asked = request, self._asked + 1
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until nothing is asked for any more; False after so long [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._answered == self._asked, timeout)

    def close(self, timeout: float | None = None) -> None:
        """Stop: what is worked on is reported no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._answered != self._asked)
                if self._closed:
                    return
                number, request = self._asked, self._request

            def stale(number: int = number) -> bool:
                return self._closed or self._asked != number

            outcome: Outcome | Exception
            try:
                outcome = self._work(request, stale)
            except Exception as error:
                outcome = error
            if not stale():
                self._tell(request, outcome)
            with self._changed:
                self._answered = number
                self._changed.notify_all()


_RANGE = 4.0  # a slider goes from so much below a problem's number to so much above
_STEPS = 200
_MARGIN = 0.06  # [m] the largest margin of the ZMP that can be asked for, at least


@dataclass(frozen=True, kw_only=True)
class Number:
    """One that a slider sets.

    name : as an argument of `Solution.moved`.  label : with its unit.  value, least, most, step : in that
    unit.
    """

    name: str
    label: str
    value: float
    least: float
    most: float
    step: float


@dataclass(frozen=True, kw_only=True)
class PlanRequest:
    """A problem that is asked for. point [m]; numbers : by their names, those that the problem has."""

    point: tuple[float, float, float]
    numbers: tuple[tuple[str, float], ...]

    def changes(self, problem: ImpactProblem) -> dict[str, Any]:
        """Differences from this problem: arguments of `Solution.moved`."""
        own = request_of(problem)
        out: dict[str, Any] = {} if self.point == own.point else {"point": np.array(self.point)}
        return out | dict(sorted(set(self.numbers) - set(own.numbers)))


def request_of(problem: ImpactProblem) -> PlanRequest:
    """Request that corresponds to the problem as it is."""
    x, y, z = (float(v) for v in problem.point)
    return PlanRequest(point=(x, y, z), numbers=tuple((n.name, n.value) for n in numbers_of(problem)))


def numbers_of(problem: ImpactProblem) -> tuple[Number, ...]:
    """Parameters that a plan can be adapted to: mass of the target, stiffness of the contact, margin of the
    ZMP.

    A wall has no mass, and an arm that is bolted down no ZMP.
    """
    found = []
    parts: tuple[tuple[str, str, Any], ...] = (
        ("mass", "target's mass", problem.target),
        ("stiffness", "contact's stiffness", problem.law),
    )
    for name, what, thing in parts:
        for field in dataclasses.fields(thing):
            if field.name == name:
                value = float(getattr(thing, name))
                unit = field.metadata["about"].unit
                found.append(_between(name, f"{what} [{unit}]", value, value / _RANGE, value * _RANGE))
    if problem.coordinates.legs:
        margin = 1e3 * problem.term(ContactWrenchCone).margin
        found.append(
            _between("margin", "margin of the ZMP [m]", margin / 1e3, 0.0, max(2e-3 * margin, _MARGIN))
        )
    return tuple(found)


def _between(name: str, label: str, value: float, least: float, most: float) -> Number:
    return Number(name=name, label=label, value=value, least=least, most=most, step=(most - least) / _STEPS)
