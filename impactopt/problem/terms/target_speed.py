"""Speed of the target after the impact."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from impactopt.contact.fields import about
from impactopt.contact.targets.base import Target
from impactopt.errors import InputError
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.terms.base import Term, bound_at_each
from impactopt.problem.violation import Measure


@dataclass(frozen=True, kw_only=True)
class TargetSpeed(Term):
    """The target's speed at separation is bounded.

    The speed is along the normal, so that of a target that moves towards the striker is negative. With both
    bounds at zero the target is caught. As it may be slow after contact, the striker then stays behind it.
    """

    name: ClassVar[str] = "target speed"
    unit: ClassVar[str] = "m/s"
    least: float = field(metadata=about("smallest speed; -inf: any", unit="m/s", endless=True))
    most: float = field(metadata=about("largest speed; inf: any", unit="m/s", endless=True))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.least > self.most:
            raise InputError(f"TargetSpeed: least is {self.least:g} m/s, most {self.most:g} m/s; swap them")

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        formula = problem.target.formula()
        return {
            "target_speed": BlockRecipe(lambda: speed(problem.target), formula),
            "target_way": BlockRecipe(lambda: way(problem.target), formula),
        }

    def add_constraints(self, program: Any) -> None:

        def numbers(target: Target) -> Any:
            return np.array(list(target.parameters.values()))

        spots, own = [("separation", [program.expected.target_state])], numbers(program.problem.target)
        bounds: dict[str, Any] = {
            "lower": self.least,
            "upper": self.most,
            "measure": Measure("m/s", 1.0, "off"),
        }
        bound_at_each(program, self, "target_speed", spots, ["normal"], own, **bounds)
        program.builder.follow(lambda b: b.block("target_speed").take_parameters(numbers(b.problem.target)))


def speed(target: Target) -> BlockExpression:
    """Speed of the target's surface.

    z = target's state;  p = target's parameters;  out = speed along the normal [m/s].
    """
    state, numbers, found = _speed(target)
    return make_block([state], [numbers], {"speed": found}, lanes=2)


def way(target: Target) -> BlockExpression:
    """Travel of the target's surface at constant speed.

    z = target's state, T [s];  p = target's parameters;  out = travel in T [m].
    """
    state, numbers, found = _speed(target)
    T = ca.SX.sym("T")
    return make_block([state, T], [numbers], {"way": T * found}, lanes=2)


def _speed(target: Target) -> tuple[Any, Any, Any]:
    state, numbers = ca.SX.sym("state", target.n_states), ca.SX.sym("numbers", len(target.parameters))
    named = {name: numbers[i] for i, name in enumerate(target.parameters)}
    return state, numbers, ca.SX(target.velocity(state, named))
