"""The time loop as a CasADi graph whose size in C is that of one step and a list of calls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from impactopt.collision.model import JointSpaceModel

__all__ = ["BLOCK", "run"]

# steps in a block: a block is skipped when the contact is over before it begins
BLOCK = 16


def run(
    model: JointSpaceModel, step: Any, start: Any, steps: int, data: Sequence[Any], *, record: bool
) -> tuple[Any, Any]:
    """(final state, states at all steps) from the state `start`, MX.

    At least `steps` steps are made, rounded up to whole blocks; the states at all steps, (n_states, steps +
    1), are in the graph only where `record` asks for them. After the end states repeat the last one.
    """
    block = _block(model, step, record)
    still = _still(model, record)
    advance = ca.Function.if_else("advance", block, still)
    running = _running(model)
    small = [x for x, name in zip(data, model.data, strict=True) if name != "A"]
    y = ca.MX(start)
    history = [y]
    for _ in range(-(-steps // BLOCK)):
        out = advance.call([running(y, *small), y, *data])
        y = out[0]
        history += out[1:]
    return y, ca.horzcat(*history) if record else None


def _block(model: JointSpaceModel, step: Any, record: bool) -> Any:
    y, data = ca.MX.sym("y", model.n_states), list(model.symbols(ca.MX).values())
    states = [y]
    for _ in range(BLOCK):
        states.append(step(states[-1], *data))
    out = [states[-1], ca.horzcat(*states[1:])] if record else [states[-1]]
    return ca.Function("block", [y, *data], out)


def _still(model: JointSpaceModel, record: bool) -> Any:
    y, data = ca.MX.sym("y", model.n_states), list(model.symbols(ca.MX).values())
    out = [y, ca.repmat(y, 1, BLOCK)] if record else [y]
    return ca.Function("still", [y, *data], out)


def _running(model: JointSpaceModel) -> Any:
    y, data = ca.SX.sym("y", model.n_states), model.small_symbols()
    return ca.Function("running", [y, *data.values()], [model.running(y, data)])
