"""Targets: how what is hit moves along the normal under the contact force."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact._expressions import Parameters, check_numbers, numbers_of, text_of
from impactopt.contact.fields import Described
from impactopt.errors import InputError

__all__ = ["UNITS", "Target"]

UNITS = {"speed": "m_s", "depth": "m"}  # of targets' results


class Target(Described, ABC):
    """Something that is hit, at rest when contact begins; motion is along the contact normal only.

    To write one, make a frozen dataclass whose fields are its numbers, and give the methods below. They have
    to be smooth but where one of `switches` changes its sign; `state` is a column of `n_states` numbers or
    CasADi symbols, zero at rest. Fields with `impactopt.contact.fields.about` as metadata are checked when a
    target is made.

    Attributes
    ----------
    word : what problem files call it; "" for one that they do not know.
    n_states : size of the state.
    results : names of what `result` gives.
    typical : sizes of the state's numbers, for scaling; ones if not given.
    events : what a plan has in the place of switches: what happens to it in a blow, in this order, each of
        which ends a phase of the contact; see `smooth`.
    phases : the contact's phases in a plan, three if there are events, which end the first of them; what is
        left before the last ends with compression, the last with contact.
    at_once : whether the first event may come with the first touch, so that the phase before it is none.
    stays : whether it waits where a blow has left it, so that the striker must keep off it afterwards.
    """

    word: ClassVar[str] = ""
    n_states: int
    results: ClassVar[tuple[str, ...]] = ()
    typical: ClassVar[tuple[float, ...]] = ()
    events: ClassVar[tuple[str, ...]] = ()
    phases: ClassVar[tuple[str, ...]] = ("compression", "restitution")
    at_once: ClassVar[bool] = False
    stays: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_numbers(self)

    @property
    def turns(self) -> bool:
        """Whether a phase ends with compression: events do not end all phases but the last."""
        return len(self.events) < len(self.phases) - 1

    @property
    def parameters(self) -> dict[str, float]:
        """The target's numbers by name; a collision model takes each as an input named `target_<name>`.

        `type(target)(**numbers)` is the same target with other numbers.
        """
        return numbers_of(self)

    @abstractmethod
    def velocity(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Velocity of the hit surface along the normal [m/s]."""

    @abstractmethod
    def derivative(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """d(state)/dt, a list of `n_states` expressions, under the contact force [N]."""

    @abstractmethod
    def energy(self, state: Any, parameters: Parameters | None = None) -> Any:
        """Energy [J] that the target holds, or has used up in what it was hit for."""

    def switches(self, state: Any, force: Any, parameters: Parameters | None = None) -> list[Any]:
        """Expressions whose changes of sign part the motion into smooth pieces; steps end on them."""
        return []

    def smooth(
        self, state: Any, force: Any, phase: int, parameters: Parameters | None = None
    ) -> tuple[Any, list[Any]]:
        """Velocity and d(state)/dt in a phase of the contact as a plan has them, where nothing may switch.

        A target without switches moves as it is. One with switches goes in a plan through `events` in a given
        order, between which it is smooth.

        Raises
        ------
        InputError : it has switches and does not say.
        """
        if self.switches(state, force, parameters):
            raise InputError(
                f"the target {type(self).__name__} has switches, which a plan cannot have: give it a method "
                "`smooth`, or plan for FreeMass, RigidWall, Nail or Board"
            )
        return self.velocity(state, parameters), self.derivative(state, force, parameters)

    def event(
        self, state: Any, force: Any, late: Any, phase: int, parameters: Parameters | None = None
    ) -> Any:
        """Zero where a phase ends, of those that `events` end; of order 1.

        late : by how much [s] it has lasted longer than it has to.
        """
        raise NotImplementedError(f"{type(self).__name__} has no events")

    def lasting(self, state: Any, force: Any, phase: int, parameters: Parameters | None = None) -> list[Any]:
        """What is not below zero while a phase lasts, one expression of order 1 or none."""
        return []

    def result(self, state: Any, parameters: Parameters | None = None) -> list[Any]:
        """What the blow has brought, from the state at separation; named by `results`."""
        return []

    def outcome(self, state: Any, parameters: Parameters | None = None) -> dict[str, float]:
        """`result` as numbers by name and unit, as reports have them: `speed_m_s`, `depth_m`, `broken`."""
        values = self.result([float(x) for x in state], parameters)
        names = [f"{name}_{UNITS[name]}" if name in UNITS else name for name in self.results]
        return {name: float(value) + 0.0 for name, value in zip(names, values, strict=True)}  # no minus zero

    def formula(self) -> tuple[str, ...]:
        """The target as text in symbols of its own: what a compiled model of it depends on."""
        numbers = {name: ca.SX.sym(name) for name in self.parameters}
        state = [ca.SX.sym(f"state_{i}") for i in range(self.n_states)]
        force = ca.SX.sym("force")
        parts = {
            "derivative": self.derivative(state, force, numbers),
            "velocity": [self.velocity(state, numbers)],
            "energy": [self.energy(state, numbers)],
            "switches": self.switches(state, force, numbers),
            "result": self.result(state, numbers),
        }
        for k, phase in enumerate(self.phases if self.events else ()):
            speed, rates = self.smooth(state, force, k, numbers)
            parts[phase] = [
                speed,
                *rates,
                *([self.event(state, force, ca.SX.sym("T"), k, numbers)] if k < len(self.events) else []),
                *self.lasting(state, force, k, numbers),
            ]
        made = [f"{name}: {text_of(expressions)}" for name, expressions in parts.items()]
        return (*made, f"results: {', '.join(self.results)}")
