"""Nonlinear program (NLP) under construction: variables, blocks, constraints and limits, for all parts.

A block is many instances of a compiled function with its derivatives.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from impactopt.arrays import Array, Index
from impactopt.codegen.batched import BatchedFunction
from impactopt.errors import InputError, did_you_mean
from impactopt.kinematics.coordinates import StanceCoordinates
from impactopt.problem.problem import ImpactProblem
from impactopt.problem.violation import Measure, Place
from impactopt.transcription import blocks as symbolic
from impactopt.transcription.layout import Affine, Constraints, Group, Layout, Limits, stack


@dataclass
class Block:
    """``count`` instances of a compiled function out = f(z, p), its Jacobian, and the Hessian of lambda.out.

    lift : z of all instances (count * n_in) as affine expressions in the program's variables.
    jac_pattern, hess_pattern : row and column indices of an instance's nonzeros.
    """

    name: str
    value: BatchedFunction
    jacobian: BatchedFunction
    hessian: BatchedFunction
    n_in: int
    n_out: int
    count: int
    lift: Affine
    jac_pattern: tuple[Index, Index]
    hess_pattern: tuple[Index, Index]

    @property
    def parameters(self) -> Array:
        """Parameters (count, n_p)."""
        return self.value.inputs[1][: self.count]

    def take_parameters(self, parameters: Array) -> None:
        """Use these parameters (count, n_p), or (n_p,) for all instances, from now on."""
        parameters = np.broadcast_to(parameters, self.parameters.shape)
        for function in (self.value, self.jacobian, self.hessian):
            function.take_parameters(parameters)

    def copy(self) -> Block:
        """Copy for another program, as a program sets the arrays that its blocks write to."""
        parts = {name: getattr(self, name).copy() for name in ("value", "jacobian", "hessian")}
        return replace(self, **parts)

    @classmethod
    def make(
        cls,
        name: str,
        functions: dict[str, Any],
        instances: Sequence[Sequence[Affine]],
        parameters: ArrayLike,
    ) -> Block:
        """Block whose z is given as parts.

        functions : compiled, of one instance or by `impactopt.transcription.simd.in_lanes`: ``name``,
            ``name_jac`` and ``name_hess``.
        instances : of each, the affine expressions ("slots") that make up its z, in order.
        parameters : (n_p,) for all instances, or (count, n_p).
        """
        n_in = functions[name].size1_in(0)
        lifts = [stack(slots) for slots in instances]
        for lift in lifts:
            if lift.size != n_in:
                raise InputError(f"block {name} takes {n_in} inputs, was given {lift.size}")
        return cls.of_lift(name, functions, stack(lifts), len(lifts), parameters)

    @classmethod
    def of_lift(
        cls, name: str, functions: dict[str, Any], lift: Affine, count: int, parameters: ArrayLike
    ) -> Block:
        """Block, as of :meth:`make`, with z of all instances (count * n_in) as one expression."""
        f, j, h = functions[name], functions[f"{name}_jac"], functions[f"{name}_hess"]
        n_in, n_out = f.size1_in(0), f.size1_out(0)
        p, n_p = np.asarray(parameters, dtype=float), f.size1_in(1)
        if p.ndim and p.shape[-1] != n_p:
            raise InputError(f"block {name} takes {n_p} parameters, was given {p.shape[-1]}")
        if p.ndim == 2 and len(p) not in (1, count):
            raise InputError(f"block {name} has {count} instances, was given parameters of {len(p)}")
        if np.isnan(p).any():
            raise InputError(f"block {name}: a parameter is NaN; give numbers")
        p = np.broadcast_to(p, (count, n_p))
        value, jacobian, hessian = (BatchedFunction(function, count, p) for function in (f, j, h))
        return cls(
            name=name,
            value=value,
            jacobian=jacobian,
            hessian=hessian,
            n_in=n_in,
            n_out=n_out,
            count=count,
            lift=lift,
            jac_pattern=jacobian.pattern,
            hess_pattern=hessian.pattern,
        )


class Builder:
    """Program under construction: a part of the program adds its variables, blocks and constraints here.

    Attributes
    ----------
    problem, coordinates, robot, limits : of the program.
    functions : compiled blocks by name.
    ny, nl, nw : number of coordinates, of the constrained legs' joints, of sole wrenches' components.
    y0 (ny,), legs0 (nl,) : posture of the stance; the start posture if no sole has stepped.
    layout, constraints, blocks : variables, constraints and blocks so far.
    lifted : variables that equal outputs of blocks, as those of :meth:`lift`; the indices of these outputs;
        and the order of elimination among them: variables that others depend on have a larger number.
    followers : functions that :meth:`follow` has been given.
    """

    def __init__(self, problem: ImpactProblem, functions: dict[str, Any]) -> None:
        coordinates = problem.coordinates
        self.problem, self.coordinates, self.robot = problem, coordinates, problem.robot
        self.functions, self.limits = functions, Limits(problem, coordinates)
        self.ny, self.nl, self.nw = coordinates.ny, coordinates.nl, 6 * len(coordinates.legs)
        self.y0, self.legs0 = coordinates.start, coordinates.start_legs
        self.layout, self.constraints = Layout(), Constraints()
        self.blocks: list[Block] = []
        self.lifted: list[tuple[Group, Index, int]] = []
        self.followers: list[Callable[[Builder], None]] = []

    def copy(self) -> Builder:
        """Copy to which other blocks and constraints can be added, but no variables."""
        other = copy.copy(self)
        other.blocks, other.constraints = [block.copy() for block in self.blocks], self.constraints.copy()
        return other

    def standing(self, coordinates: StanceCoordinates, node: str) -> Builder:
        """The same program, to add a phase on other soles.

        coordinates : of that stance phase.  node : name of its block ``node``.
        """
        other = copy.copy(self)
        # a shallow copy: variables, blocks and constraints are the same lists, to which both builders add
        other.coordinates, other.limits = coordinates, Limits(self.problem, coordinates)
        other.ny, other.nl, other.nw = coordinates.ny, coordinates.nl, 6 * len(coordinates.legs)
        other.y0, other.legs0 = coordinates.start, coordinates.start_legs
        other.functions = dict(self.functions)
        for of in ("", "_jac", "_hess"):
            # so `add_nodes` does not have to know the stance
            other.functions[f"node{of}"] = self.functions[f"{node}{of}"]
        return other

    def follow(self, take: Callable[[Builder], None]) -> None:
        """Register a function that updates parameters and bounds when the problem changes.

        take : writes them to the blocks, constraints and variables of a builder, this one or a copy, from its
            ``problem``.
        """
        self.followers.append(take)

    def duration(self, name: str, bounds: tuple[float, float], scale: float) -> Group:
        """Add a duration [s] as a variable."""
        limits = {"lower": bounds[0], "upper": bounds[1]}
        seconds = Measure("s", 1.0, "off")
        return self.layout.add(name, 1, 1, scale=scale, labels=["T"], measure=seconds, **limits)

    def block(self, name: str) -> Block:
        """First block of this name."""
        return next(block for block in self.blocks if block.name == name)

    def add_block(self, name: str, instances: list[Any], parameters: Array) -> int:
        """Add a block; returns the index of its first output.

        instances : of each, the affine expressions ("slots") that make up z, in order.
        parameters : p (n_p,) of all instances, or (count, n_p).
        """
        if name not in self.functions:
            raise InputError(
                f"there is no block {name!r}{did_you_mean(name, self.functions)}: return it from `blocks` of "
                "the term or objective that asks for it"
            )
        return self.append(Block.make(name, self.functions, instances, parameters))

    def append(self, block: Block) -> int:
        """Add a block that is made already; returns the index of its first output."""
        at = self.n_outputs
        self.blocks.append(block)
        return at

    @property
    def n_outputs(self) -> int:
        """Number of outputs of all blocks so far."""
        return sum(b.count * b.n_out for b in self.blocks)

    def lift(
        self,
        name: str,
        outputs: Index,
        *,
        term: str = "",
        place: Place | str = "",
        labels: Sequence[str] | None = None,
        measure: Measure | None = None,
        scale: float = 1.0,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
    ) -> Group:
        """Add variables that equal outputs of blocks, for use in several constraints or the objective.

        term, place, measure : of the constraints that equate them; the default term is ``name``.
        scale, lower, upper : of the variables.
        """
        size = len(outputs)
        labels = labels or ([name] if size == 1 else [f"{name} {k}" for k in range(size)])
        group = self.layout.add(
            name, 1, size, lower=lower, upper=upper, scale=scale, labels=labels, measure=measure
        )
        self.equal(term or name, place, labels, outputs, measure, affine=-group[0])
        self.lifted.append((group, np.asarray(outputs, dtype=np.intp), 0))
        return group

    def equal(
        self,
        term: str,
        place: Place | str,
        components: Sequence[str],
        outputs: Any = None,
        measure: Measure | Sequence[Measure] | None = None,
        *,
        affine: Affine | None = None,
    ) -> None:
        """Constrain outputs of blocks, affine expressions, or the sums of both, to zero."""
        self.constraints.add(
            term=term,
            place=place,
            components=components,
            outputs=outputs,
            affine=affine,
            lower=0,
            upper=0,
            measure=measure,
        )

    def parts(self, block: str) -> dict[str, Any]:
        """Indices of the named slices of a block's output, within an instance."""
        size = symbolic.sizes(self.coordinates, self.problem, block)
        offset = np.cumsum([0, *size.values()])
        return {k: np.arange(offset[i], offset[i + 1]) for i, k in enumerate(size)}
