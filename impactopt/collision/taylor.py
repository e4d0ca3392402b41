"""Steps 3b to 7b of the paper as Taylor steps that end on events.

Between events (end of compression, separation, a joint entering or leaving saturation or its friction's
transition band, a switch of the target) the equations are smooth, and linear but for law and target. So a
step takes the phase at its start, computes the state's first time derivatives, looks along Taylor's
polynomials for the first event, and ends there or after its full length. Each order costs one product with
the robot's inverse inertia, as a stage of a Runge-Kutta method does; for linear equations of order four it is
the classical one.
"""

from __future__ import annotations

from math import factorial, pi
from typing import Any

import casadi as ca

from impactopt.collision.events import first_event, level_jet, newton, refine
from impactopt.collision.jets import Jet, derivative, value_at
from impactopt.collision.model import JointSpaceModel

__all__ = ["LEFT_OUT_BY_TAYLOR", "taylor_step"]

# with steps of 0.25 ms the sixth order is worth 200 times the accuracy of the fourth, for half as much again
ORDER = 6
# of |f^(6)| h^7, summed over steps, what is left out of the impulse: the next term of its polynomial, and as
# much again for the errors of the motion that come with it
LEFT_OUT_BY_TAYLOR = pi / factorial(ORDER + 1)


def taylor_step(model: JointSpaceModel, length: float) -> Any:
    """ca.Function step(y, *data) -> y at the next event, or `length` [s] later; y itself after separation."""
    y, data = ca.SX.sym("y", model.n_states), model.small_symbols()
    motion = _Motion(model, y, data)
    longest = model.longest(y, data, length)
    events = motion.events(longest)
    time, at = ca.SX.sym("time"), ca.SX.sym("at", len(events))
    h = model.running(y, data) * refine(events, longest, time, at)
    top = ca.SX.sym("top")
    parts = {name: value_at(jet, h) for name, jet in motion.jets.items()}
    if model.peak:
        parts["peak"] = ca.fmax(parts["peak"], value_at(motion.forces, top))
    if model.error:
        parts["left_out"] += LEFT_OUT_BY_TAYLOR * ca.fabs(motion.forces[ORDER]) * h ** (ORDER + 1)
    y_next = model.join(parts)

    # A tau stays one product in the code, between functions for all that is done joint by joint; and the
    # search for events, whose result `refine` makes differentiable, is kept out of derivatives
    known = [y, *data.values()]
    first = first_event(events, longest)
    found = [*first, _top(motion.forces, model.running(y, data) * refine(events, longest, *first))]
    search = ca.Function("search", [*known, *motion.symbols], found, {"is_diff_out": [False] * 3})
    finish = ca.Function("finish", [*known, *motion.symbols, time, at, top], [y_next])
    Y, D = ca.MX.sym("y", model.n_states), model.symbols(ca.MX)
    given = [Y, *[D[name] for name in data]]
    torque, impulse, time_passed = (model.part(Y, name) for name in ("torque", "impulse", "time"))
    made: list[Any] = []
    for k in range(ORDER):
        stage = ca.Function(f"stage_{k}", [*known, *motion.symbols[: 3 * k + 1]], motion.stages[k])
        u = model.velocity_from(torque, impulse, time_passed, D)
        made.append(u + D["velocity_before"] if model.refrozen and k == 0 else u)
        torque, impulse = stage(*given, *made)
        made += [torque, impulse]
        time_passed = float(k == 0)
    return ca.Function(
        "step", [Y, *D.values()], [finish(*given, *made, *search(*given, *made))], ["y", *D], ["y_next"]
    )


def _top(forces: Jet, length: Any) -> Any:
    """[s] where within a step the force is largest; 0 where that is at an end: the next step begins there."""
    rate = forces[1:]
    rise, fall = rate[0], value_at(rate, length)
    inside = ca.logic_and(rise > 0, fall < 0)
    time = length * rise / ca.if_else(inside, rise - fall, 1.0)
    for _ in range(3):
        time = ca.fmin(ca.fmax(newton(rate, time), 0.0), length)
    return ca.if_else(inside, time, 0.0)


class _Motion:
    """Time derivatives of a state's parts, and of what depends on it, in the phase at this state.

    Order by order: joint velocity, torque and force are symbols for what depends on them.

    Attributes
    ----------
    jets : of the state's parts.
    symbols : joint velocity (n), torque less friction (n) and force, and their derivatives, order by order.
    stages : for each order, expressions of the last two from what comes before in `symbols`.
    """

    def __init__(self, model: JointSpaceModel, y: Any, data: dict[str, Any]) -> None:
        self.model, self.data = model, data
        self.compressing, _ = model.phase(y, data)
        self.jets: dict[str, list[Any]] = {name: [model.part(y, name)] for name in model.layout}
        self.jets["time"].append(1.0)
        self.target: list[list[Any]] = [[self.jets["target"][0][i]] for i in range(model.target.n_states)]
        self.stages: list[list[Any]] = []
        self.symbols: list[Any] = []
        self.rates: list[Any] = []  # of penetration
        self.forces: list[Any] = []
        self.demands: list[Any] = []
        self.joint_rates: list[Any] = []
        for k in range(ORDER):
            self._order(k)
        self.forces.append(self._force(ORDER))

    def _order(self, k: int) -> None:
        """The state's derivatives of order k + 1."""
        model, jets = self.model, self.jets
        u, tau = ca.SX.sym(f"velocity_{k}", model.n), ca.SX.sym(f"torque_{k}", model.n)
        f = ca.SX.sym(f"force_{k}")
        self.symbols += [u, tau, f]
        self.stages.append([self._torque(k, u), self._force(k)])
        self.forces.append(f)
        numbers = model.target_numbers(self.data)
        for i in range(len(self.target)):
            self.target[i].append(
                derivative(
                    lambda f, *z, i=i: model.target.derivative(z, f, numbers)[i],
                    [self.forces, *self.target],
                    k,
                )
            )
        jets["torque"].append(tau)
        jets["impulse"].append(f)
        jets["penetration"].append(self.rates[k])
        jets["target"].append(ca.vertcat(*[state[k + 1] for state in self.target]))
        if model.terms.stiffness:
            jets["deviation"].append(-u)
        if model.second_integrals:
            jets["torque2"].append(jets["torque"][k])
            jets["impulse2"].append(jets["impulse"][k])

    def _y(self, k: int) -> Any:
        """k-th derivative of the state, where it is known; the peak has none that matters."""
        return self.model.join({name: jet[k] if k < len(jet) else 0.0 for name, jet in self.jets.items()})

    def _force(self, k: int) -> Any:
        """k-th derivative of the force, and of the rate of penetration (paper, eqs. 15-17)."""
        model = self.model
        law, target = model.law_numbers(self.data), model.target_numbers(self.data)
        speed = model.hand_speed_change(self._y(k), self.data)
        if k == 0:
            speed = speed + self.data["hand_speed"]
        self.rates.append(speed - derivative(lambda *z: model.target.velocity(z, target), self.target, k))
        compression, restitution = (
            derivative(
                lambda x, r, c=c: model.law.branch(x, r, c, law), [self.jets["penetration"], self.rates], k
            )
            for c in (True, False)
        )
        return ca.if_else(self.compressing, compression, restitution)

    def _torque(self, k: int, u: Any) -> Any:
        """k-th derivative of torque less friction (paper, eqs. 10-12), from u, that of the joint velocity."""
        model, data, terms = self.model, self.data, self.model.terms
        demand = model.servo(self._y(k), u, data)
        if k == 0:
            demand = model.with_feedforward(demand, data)
            tau = model.saturate(demand, data)
            self.free = tau == demand
        else:
            # a product: CasADi would carry an if_else into each entry of A tau
            tau = self.free * demand if terms.saturation else demand
        self.demands.append(demand)
        if not terms.friction:
            return tau
        if k == 0:
            self.joint_rates.append(data["joint_velocity"] + u)
            self.sliding = ca.fabs(self.joint_rates[0]) > model.transition
            return tau - model.friction(u, data)
        self.joint_rates.append(u)
        return tau - (data["viscous"] + (1 - self.sliding) * data["coulomb"] / model.transition) * u

    def events(self, length: Any) -> list[Jet]:
        """Jets that cross zero at the end of the present phase."""
        model = self.model
        # the force ends restitution; while compressing it stands aside, at a constant
        separation = [ca.if_else(self.compressing, float(k == 0), f) for k, f in enumerate(self.forces)]
        jets: list[Jet] = [self.rates, separation]
        for i in range(model.n):
            if model.terms.saturation:
                jets.append(level_jet([x[i] for x in self.demands], self.data["torque_limit"][i], length))
            if model.terms.friction:
                jets.append(level_jet([x[i] for x in self.joint_rates], model.transition, length))
        return [*jets, *self._target_switches()]

    def _target_switches(self) -> list[Jet]:
        """Jets of the target's switches, each of the piece that the step starts in."""
        target, numbers = self.model.target, self.model.target_numbers(self.data)
        known = [self.forces, *self.target]
        pieces = range(len(target.switches([jet[0] for jet in self.target], self.forces[0], numbers)))
        return [
            [
                derivative(lambda f, *z, i=i: target.switches(z, f, numbers)[i], known, k)
                for k in range(ORDER + 1)
            ]
            for i in pieces
        ]
