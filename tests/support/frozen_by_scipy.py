"""One frozen collision of any law and target by SciPy, phase by phase, from the numbers that are frozen."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from impactopt import SDC
from impactopt.collision.graph import frozen_dynamics, joint_space_model, target_start


def _frozen(model: SDC, q: Any, v: Any, values: dict[str, Any]) -> dict[str, Any]:
    function = frozen_dynamics(model).function("frozen", joint_space_model(model).frozen)
    numbers = {name: float(values[f"target_{name}"]) for name in model.target.parameters}
    found = function.call([q, v, values["normal"], target_start(model.target, numbers)])
    return {name: np.array(x) for name, x in zip(function.name_out(), found, strict=True)}


def _gain(values: dict[str, Any], name: str, n: int) -> Any:
    gain = values.get(name, np.zeros(n))
    return np.diag(gain) if np.ndim(gain) == 1 else gain


class FrozenCollision:
    """y = (penetration, impulse, target's state, torque's integral, deviation)."""

    def __init__(self, model: SDC, q: Any, v: Any, torque: Any, values: dict[str, Any]) -> None:
        frozen, n = _frozen(model, q, v, values), model.n_servos
        A = np.zeros((n, n))
        A[np.triu_indices(n)] = frozen["A"].ravel()
        self.A, self.s, self.m = A + np.triu(A, 1).T, frozen["s"].ravel(), frozen["m"].item()
        self.d = frozen["d"].ravel() if "d" in frozen else np.zeros(n)
        self.e = frozen["e"].item() if "e" in frozen else 0.0
        self.speed, self.joint_velocity = frozen["hand_speed"].item(), np.asarray(v)[-n:]
        self.model, self.values, self.torque = model, values, 0.0 if torque is None else torque
        self.kd, self.kp = _gain(values, "kd", n), _gain(values, "kp", n)
        self.law = type(model.law)(**{k: float(values[f"contact_{k}"]) for k in model.law.parameters})
        self.hit = type(model.target)(**{k: float(values[f"target_{k}"]) for k in model.target.parameters})
        self.k, self.n = model.target.n_states, n

    def rate(self, t: float, y: Any) -> float:
        hand = self.speed + self.s @ y[2 + self.k : 2 + self.k + self.n] - self.m * y[1] + self.e * t
        return float(hand - self.hit.velocity([*y[2 : 2 + self.k]]))

    def flow(self, t: float, y: Any, compressing: bool) -> Any:
        effects, values, rate = self.model.effects, self.values, self.rate(t, y)
        force = float(self.law.branch(float(y[0]), rate, compressing))
        force = max(force, 0.0) if compressing else force
        u = self.A @ y[2 + self.k : 2 + self.k + self.n] - self.s * y[1] + self.d * t
        tau = self.torque - self.kd @ u + self.kp @ y[2 + self.k + self.n :]
        if effects.saturation:
            tau = np.clip(tau, -values["torque_limit"], values["torque_limit"])
        if effects.friction:
            w = self.joint_velocity + u
            slips = np.clip(w / self.model.joint_friction.transition, -1.0, 1.0)
            tau = tau - values["viscous"] * w - values["coulomb"] * slips
        moved = [float(x) for x in self.hit.derivative([*y[2 : 2 + self.k]], force)]
        return np.concatenate([[rate, force], moved, tau, -u])

    def run(self) -> tuple[float, float]:
        """(impulse [N s], duration [s]); it has to separate."""

        def turns(t: float, y: Any, _: bool) -> float:
            return self.rate(t, y)

        def parts(t: float, y: Any, _: bool) -> float:
            return float(self.law.separation(float(y[0]), min(self.rate(t, y), 0.0)))

        t, y, compressing = 0.0, np.zeros(2 + self.k + 2 * self.n), True
        turns.terminal = parts.terminal = True  # type: ignore[attr-defined]
        parts.direction = -1  # type: ignore[attr-defined]
        while t < self.model.horizon:
            turns.direction = -1 if compressing else 1  # type: ignore[attr-defined]
            events = [turns] if compressing else [turns, parts]
            way = solve_ivp(
                self.flow, (t, self.model.horizon), y, args=(compressing,), method="DOP853", rtol=1e-11,
                atol=1e-15, events=events, max_step=2e-4,
            )  # fmt: skip
            t, y = way.t[-1], way.y[:, -1]
            if not compressing and way.t_events[1].size:
                return float(y[1]), float(t)
            compressing = not compressing
        raise AssertionError("no separation")
