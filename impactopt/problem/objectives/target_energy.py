"""Energy that the target absorbs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import casadi as ca

from impactopt.contact.targets.base import Target
from impactopt.problem.block import BlockExpression, BlockRecipe, make_block
from impactopt.problem.objectives.base import WEIGHT, Objective


@dataclass(frozen=True, kw_only=True)
class TargetEnergy(Objective):
    """The energy that the target has absorbed at separation, with the work done in it.

    In J: ``Target.energy``. A board with damping is refused, as its energy lacks the work of that.
    """

    name: ClassVar[str] = "target energy"
    unit: ClassVar[str] = "J"
    weight: float = field(default=1.0, metadata=WEIGHT)

    def blocks(self, problem: Any, coordinates: Any) -> dict[str, BlockRecipe]:
        return {"energy": BlockRecipe(lambda: energy(problem.target), problem.target.formula())}

    def quantity(self, program: Any) -> Any:
        return program.target_energy()


def energy(target: Target) -> BlockExpression:
    """Energy that the target holds or has absorbed.  z = its state;  p = its parameters;  out = energy
    [J].
    """
    state, numbers = ca.SX.sym("state", target.n_states), ca.SX.sym("numbers", len(target.parameters))
    named = {name: numbers[i] for i, name in enumerate(target.parameters)}
    return make_block([state], [numbers], {"energy": ca.SX(target.energy(state, named))}, lanes=2)
