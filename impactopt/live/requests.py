"""Requests of live pages, and the thread that answers the latest one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from impactopt.contact.fields import abouts
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.terms import ContactWrenchCone

Request = TypeVar("Request")
Outcome = TypeVar("Outcome")


class LatestRequest(Generic[Request, Outcome]):
    """Thread that answers requests. A request that comes during the work on another one replaces it.

    work : makes the outcome of a request. Its second argument returns True once there is a newer request:
        then it may stop, as its outcome is dropped.
    show : called with a request and its outcome, or the exception that the work raised, in the same thread.
    """

    def __init__(
        self,
        work: Callable[[Request, Callable[[], bool]], Outcome],
        show: Callable[[Request, Outcome | Exception], object],
    ) -> None:
        self._work, self._show = work, show
        self._changed = threading.Condition()
        # numbers of the latest request, and of the latest one that is answered
        self._requested, self._answered, self._closed = 0, 0, False
        self._request: Request
        self._thread = threading.Thread(target=self._run, name="latest request", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Replace all earlier requests by this one."""
        with self._changed:
            self._request, self._requested = request, self._requested + 1
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the latest request is answered; False after ``timeout`` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: self._answered == self._requested, timeout)

    def close(self, timeout: float | None = None) -> None:
        """End the thread; the outcome of present work is dropped."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._answered != self._requested)
                if self._closed:
                    return
                number, request = self._requested, self._request

            def stale(number: int = number) -> bool:
                return self._closed or self._requested != number

            outcome: Outcome | Exception
            try:
                outcome = self._work(request, stale)
            except Exception as error:
                outcome = error
            if not stale():
                self._show(request, outcome)
            with self._changed:
                self._answered = number
                self._changed.notify_all()


_RANGE = 4.0  # factor from a parameter's value in the problem to the ends of its slider
_STEPS = 200  # of a slider
_MARGIN = 0.06  # [m] end of the slider for the margin of the soles' CoP, or more
_PREFIXES = {"M": 1e6, "k": 1e3, "": 1.0}  # the page's number fields show five digits


@dataclass(frozen=True, kw_only=True)
class SliderParameter:
    """Parameter of a problem with a slider.

    name : as an argument of `Solution.moved`.  label : with the unit.  value, least, most, step : in that
    unit.  scale : that unit in SI.
    """

    name: str
    label: str
    value: float
    least: float
    most: float
    step: float
    scale: float = 1.0


@dataclass(frozen=True, kw_only=True)
class PlanRequest:
    """Request of a plan.

    point [m] : hit point.  parameters : names and values of the sliders, in their units.
    """

    point: tuple[float, float, float]
    parameters: tuple[tuple[str, float], ...]

    def changes(self, problem: ImpactProblem) -> dict[str, Any]:
        """Differences from a problem, as arguments of `Solution.moved`."""
        own, scales = request_of(problem), {p.name: p.scale for p in slider_parameters(problem)}
        out: dict[str, Any] = {} if self.point == own.point else {"point": np.array(self.point)}
        changed = sorted(set(self.parameters) - set(own.parameters))
        return out | {name: value * scales[name] for name, value in changed}


def request_of(problem: ImpactProblem) -> PlanRequest:
    """Request of the plan for the problem itself."""
    x, y, z = (float(v) for v in problem.point)
    parameters = tuple((p.name, p.value) for p in slider_parameters(problem))
    return PlanRequest(point=(x, y, z), parameters=parameters)


def slider_parameters(problem: ImpactProblem) -> tuple[SliderParameter, ...]:
    """Parameters with sliders: mass of the target, stiffness of the contact, margin of the centre of pressure
    in each sole; those that the problem has.
    """
    found = []
    parts: tuple[tuple[str, str, Any, dict[str, float]], ...] = (
        ("mass", "target's mass", problem.target, {"": 1.0}),
        ("stiffness", "contact's stiffness", problem.law, _PREFIXES),
    )
    for name, what, thing, prefixes in parts:
        for field, about in abouts(type(thing)):
            if field.name == name:
                value = float(getattr(thing, name))
                prefix = next((key for key, scale in prefixes.items() if value >= scale), "")
                scale, label = prefixes[prefix], f"{what} [{prefix}{about.unit}]"
                value /= scale
                found.append(_between(name, label, value, value / _RANGE, value * _RANGE, scale))
    if problem.coordinates.legs:
        margin = problem.term(ContactWrenchCone).margin
        found.append(
            _between("margin", "margin of the soles' CoP [m]", margin, 0.0, max(2 * margin, _MARGIN))
        )
    return tuple(found)


def _between(
    name: str, label: str, value: float, least: float, most: float, scale: float = 1.0
) -> SliderParameter:
    step = (most - least) / _STEPS
    return SliderParameter(
        name=name, label=label, value=value, least=least, most=most, step=step, scale=scale
    )
