"""The collisions that speed is measured on, and the compiled functions of their models.

Contacts whose force nearly dies away and comes back are decided by a hair (see docs/reproduce.md): no model's
error on them says anything. These end, in full dynamics, after 73 ms (stand-in, motion B-3) and 58 ms (TALOS,
C-3), and are no such.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from benchmarks.cases import Case, paper_motions
from benchmarks.clock import runner
from impactopt.codegen.cache import cached
from impactopt.collision import SDC, Collision
from impactopt.collision.symbolic import SymbolicModel
from impactopt.contact import ContactLaw, FreeMass, SpringDamper, Target
from impactopt.robots.presets import load_robot

Array = NDArray[np.float64]

# robot: which of the paper's nine motions
MOTIONS = {"standin": "B-3", "talos": "C-3"}
# what an evaluation of the default model gives
EVALUATION = ("impulse", "force", "zmp", "torque")


@dataclass(frozen=True, kw_only=True, eq=False)
class Setup:
    """One collision: a case, and what is hit how; the paper's contact law and target (its section III)."""

    name: str
    case: Case
    law: ContactLaw = field(default_factory=lambda: SpringDamper(stiffness=1e4, damping=300.0))
    target: Target = field(default_factory=lambda: FreeMass(mass=5.0))
    horizon: float = 0.1

    @classmethod
    def of(cls, robot: str) -> Setup:
        """The motion of that robot in MOTIONS.

        Raises
        ------
        InputError : its files are not installed.
        """
        cases = paper_motions(load_robot(robot))
        return cls(name=robot, case=next(case for case in cases if case.name == MOTIONS[robot]))

    @property
    def options(self) -> dict[str, Any]:
        """What all models share."""
        case = self.case
        shared: dict[str, Any] = {"robot": case.robot, "striker": case.striker, "normal": case.normal}
        return shared | {"law": self.law, "target": self.target, "horizon": self.horizon}

    def model(self, kind: Any = SDC, **options: Any) -> Any:
        return kind(**{**self.options, **options})


def inputs(model: SymbolicModel, case: Case) -> list[Any]:
    """Of the model's functions, all settings being inputs."""
    return [case.q, case.v, *([case.torque] if model.effects.feedforward else []), *model.settings.values()]


def compiled(model: SymbolicModel, outputs: tuple[str, ...], *, every: int = 1) -> Any:
    """The collision as the C code written by hand, all settings being inputs."""
    return model._collision(outputs, every)


def compiled_gradient(model: SymbolicModel, output: str) -> Any:
    """The collision's output and its gradient in q and v, likewise."""
    return model._gradient(output)


def graph(model: SymbolicModel, outputs: tuple[str, ...], *, every: int = 1) -> Any:
    """The collision as CasADi's C code of its graph."""
    recipe = (*model._recipe, *outputs, every)
    return cached("bench_graph", recipe, lambda: [model.graph(outputs, every=every)])["collision"]


def outcome(model: SymbolicModel, case: Case, *, every: int = 1) -> Collision:
    """The collision with all its outputs, by the compiled function."""
    function = compiled(model, model.available, every=every)
    found = function.call([ca.DM(x) for x in inputs(model, case)])
    outputs = {name: np.array(x) for name, x in zip(model.available, found, strict=True)}
    return Collision.from_outputs(outputs, model.target)


def run_of(
    model: SymbolicModel, case: Case, outputs: tuple[str, ...], *, every: int = 1
) -> Callable[[], Any]:
    """Evaluates the compiled function once a call."""
    return runner(compiled(model, outputs, every=every), inputs(model, case))
