"""Least-squares fit of one contact law to measured impacts, with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares
from scipy.special import stdtrit

from impactopt.arrays import Array
from impactopt.collision.sdc import VirtualMass
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass
from impactopt.identification.free_parameters import MASS, FreeParameter, free_parameters, initial_guesses
from impactopt.identification.log import MeasuredImpact, noise_of
from impactopt.identification.result import Estimate, LawFit
from impactopt.robots.robot import Robot, Striker

_HEAVY = 1e6  # [kg] of the mass that hardly moves
MAX_HAND_MASS = 1e5  # [kg]
_INSTANTS = 1500  # of a history, over its horizon
_COLLISION_TOLERANCE = 1e-10  # tight, because derivatives are differences of collisions


@lru_cache(maxsize=1)
def _heavy_hand() -> Robot:
    """Robot with a single prismatic joint that moves a heavy mass."""
    model = pin.Model()
    model.name = "heavy_hand"
    model.addBodyFrame("base", 0, pin.SE3.Identity(), 0)
    bounds = [np.array([x]) for x in (1e3, 1e3, -1e3, 1e3)]  # torque, speed, lower, upper
    slide = model.addJoint(0, pin.JointModelPX(), pin.SE3.Identity(), "slide", *bounds)
    model.addJointFrame(slide, model.getFrameId("base"))
    model.appendBodyToJoint(slide, pin.Inertia.FromSphere(_HEAVY, 0.1), pin.SE3.Identity())
    striker = Striker(name="hand", frame="slide", point=np.zeros(3))
    return Robot.from_model(model, name="heavy_hand", strikers=(striker,))


@dataclass(frozen=True)
class ContactHistory:
    """History of one simulated contact at its instants (k,).

    time [s] since the touch; force [N]; impulse [N s] so far.
    """

    time: Array
    force: Array
    impulse: Array

    def force_at(self, t: Array) -> Array:
        """Force [N] at times [s] since the touch; zero before and after the contact."""
        return np.interp(t, self.time, self.force, left=0.0, right=0.0)

    def slope_at(self, t: Array) -> Array:
        """Slope [N/s] of the force at times [s] since the touch."""
        return np.interp(t, self.time, np.gradient(self.force, self.time), left=0.0, right=0.0)

    def impulse_at(self, t: Array) -> Array:
        """Impulse [N s] up to times [s] since the touch."""
        return np.interp(t, self.time, self.impulse)

    def impulse_integral_at(self, t: Array) -> Array:
        """Integral [N s2] of the impulse up to times [s] since the touch; it grows on after the contact.

        Over a mass it is the displacement by the contact.
        """
        after = self.impulse[-1] * np.maximum(t - self.time[-1], 0.0)
        return np.interp(t, self.time, cumulative_trapezoid(self.impulse, self.time, initial=0.0)) + after


class TwoMassModel:
    """Two masses that collide under one contact law, whose parameters, mass and speed are inputs.

    The relative motion of two free masses is that of their reduced mass against a fixed one, or against one
    that moves on at constant speed. So a hand of 1000 t, which hardly slows down, hits a target with the
    reduced mass, an input of the compiled collision.

    Parameters
    ----------
    law : whose parameters are replaced.
    longest : [s] that a contact may last.
    """

    def __init__(self, law: ContactLaw, longest: float) -> None:
        # powers of two, so that few horizons are ever compiled
        horizon = 2.0 ** np.ceil(np.log2(longest))
        self.law = law
        self._model = VirtualMass(
            robot=_heavy_hand(),
            striker="hand",
            normal=np.array([1.0, 0.0, 0.0]),
            law=law,
            target=FreeMass(mass=1.0),
            horizon=horizon,
            step=horizon / _INSTANTS,
            tolerance=_COLLISION_TOLERANCE,
        )

    def histories(self, parameters: Mapping[str, Array], mass: Array, speed: Array) -> list[ContactHistory]:
        """Simulates N contacts.

        parameters : of the law, (N,) each.  mass : (N,) [kg], reduced, up to `MAX_HAND_MASS`.  speed : (N,)
        [m/s] of approach.
        """
        struck = 1.0 / (1.0 / mass - 1.0 / _HEAVY)  # with the heavy hand, it has the reduced mass
        settings: dict[str, Any] = {f"contact_{name}": values for name, values in parameters.items()}
        found = self._model.batch(
            np.zeros((len(speed), 1)),
            speed[:, None],
            outputs=("time", "force", "target_speed", "duration"),
            threads=1,
            target_mass=struck,
            **settings,
        )
        cases = zip(found["time"], found["force"], struck[:, None] * found["target_speed"], strict=True)
        return [_history(*case) for case in cases]


def _history(time: Array, force: Array, impulse: Array) -> ContactHistory:
    """History from padded arrays (k,)."""
    last = int(np.searchsorted(time, time[-1])) + 1  # padding repeats the last instant
    if not np.isfinite(time).all() or last < 2:  # no contact, as of a law without any force
        return ContactHistory(np.array([0.0, 1e-9]), np.zeros(2), np.zeros(2))
    return ContactHistory(time[:last], force[:last], impulse[:last])


_MAX_DURATION = 2.5  # of a simulated contact, over the longest measured one
_DIFFERENCE = 1e-4  # of z, for central differences
_ROUNDS = 2  # of re-weighting force and motion by the residuals of the fit
# Least standard deviation, relative to peak force and to the hand's motion: no log has less noise than the
# error of our interpolation.
_MIN_NOISE = 1e-5
_COARSE, _FINE = 1e-5, 1e-10  # tolerances of the fit of a single impact, and of the final one
_NEIGHBOURS = 2  # gaps between samples to each side of the estimated touch in which it may be


@dataclass(frozen=True)
class _Weights:
    """Standard deviations of force [N] and motion [m/s] or [m]."""

    force: float
    motion: float


@dataclass
class _Fit:
    """Least-squares problem of impacts that share a law and a mass.

    The unknowns z are first the shared parameters, then for each impact its speed, its instant of touch and,
    if travel is measured, the travel at the touch; each scaled.

    fixed : parameters of the law that are not fitted.
    touches : bounds [s] of each impact's touch.
    """

    model: TwoMassModel
    free: tuple[FreeParameter, ...]
    impacts: Sequence[MeasuredImpact]
    target_mass: float
    weights: _Weights
    fixed: dict[str, float]
    touches: list[tuple[float, float]] = field(default_factory=list)

    @property
    def per_impact(self) -> int:
        """Number of unknowns of each impact."""
        return 3 if self.impacts[0].travels else 2

    def of_impact(self, k: int) -> slice:
        """Slice of z with the unknowns of an impact."""
        begin = len(self.free) + k * self.per_impact
        return slice(begin, begin + self.per_impact)

    def with_shared(self, shared: Array) -> Array:
        """z with these shared parameters, and an initial guess for each impact."""
        return np.concatenate([shared, *(self._initial_guess(k) for k in range(len(self.impacts)))])

    def _initial_guess(self, k: int) -> Array:
        low, high = self.touches[k]
        touch = self._scaled(k, np.clip(_touch_estimate(self.impacts[k]), low, high))
        return np.array([1.0, touch, 0.0][: self.per_impact])

    def _scaled(self, k: int, touch: float) -> float:
        return float((touch - _touch_estimate(self.impacts[k])) / self.impacts[k].duration)

    def touch(self, k: int, z: Array) -> float:
        """Instant [s] at which an impact begins."""
        return float(_touch_estimate(self.impacts[k]) + z[self.of_impact(k)][1] * self.impacts[k].duration)

    def speed(self, k: int, z: Array) -> float:
        """Speed [m/s] of an impact at the touch."""
        return float(z[self.of_impact(k)][0] * self.impacts[k].speed)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of z."""
        low = [each.lower for each in self.free]
        high = [each.upper for each in self.free]
        high[-1] = min(high[-1], float(np.log(0.5 * MAX_HAND_MASS / self.free[-1].scale)))  # of the mass
        for k in range(len(self.impacts)):
            earliest, latest = (self._scaled(k, touch) for touch in self.touches[k])
            low += [0.1, earliest, -np.inf][: self.per_impact]
            high += [10.0, latest, np.inf][: self.per_impact]
        return np.array(low), np.array(high)

    # ------------------------------------------------------------ collisions
    def _histories(self, shared: Array, speed: Array) -> tuple[list[ContactHistory], Array]:
        """Contacts, and masses (N,) [kg] of the hand, for shared parameters (N, shared) and speeds (N,)."""
        parameters = {each.name: each.value(z) for each, z in zip(self.free, shared.T, strict=True)}
        mass = parameters.pop(MASS)
        parameters |= {name: np.full(len(shared), value) for name, value in self.fixed.items()}
        reduced = 1.0 / (1.0 / mass + 1.0 / self.target_mass)
        return self.model.histories(parameters, reduced, speed), mass

    def _predicted(self, k: int, z: Array, history: ContactHistory, mass: float, speed: float) -> Array:
        """Weighted force and motion (2 samples,) of one impact at its samples."""
        impact = self.impacts[k]
        t = impact.time - self.touch(k, z)
        if impact.travels:
            begin = z[self.of_impact(k)][2] * impact.speed * impact.duration + impact.motion[impact.touch]
            motion = begin + speed * t - history.impulse_integral_at(t) / mass
        else:
            motion = speed - history.impulse_at(t) / mass
        force = np.where(impact.clipped, 0.0, history.force_at(t))
        return np.concatenate([force / self.weights.force, motion / self.weights.motion])

    def measured(self) -> Array:
        """Weighted force and motion of all impacts as measured; clipped samples of force are 0."""
        both = [
            (np.where(i.clipped, 0.0, i.force) / self.weights.force, i.motion / self.weights.motion)
            for i in self.impacts
        ]
        return np.concatenate([part for pair in both for part in pair])

    def residuals(self, z: Array) -> Array:
        """Weighted residuals, of force and then motion of each impact."""
        n = len(self.impacts)
        speeds = np.array([self.speed(k, z) for k in range(n)])
        histories, mass = self._histories(np.tile(z[: len(self.free)], (n, 1)), speeds)
        return (
            np.concatenate([self._predicted(k, z, histories[k], mass[k], speeds[k]) for k in range(n)])
            - self.measured()
        )

    def best_of(self, guesses: Sequence[Array]) -> Array:
        """The guess of z with the least squares of the first impact's residuals."""
        speeds = np.array([self.speed(0, z) for z in guesses])
        histories, mass = self._histories(np.array(guesses)[:, : len(self.free)], speeds)
        cases = zip(guesses, histories, mass, speeds, strict=True)
        measured = self.measured()[: 2 * len(self.impacts[0].time)]
        costs = [float(np.sum((self._predicted(0, *case) - measured) ** 2)) for case in cases]
        return guesses[int(np.argmin(costs))]

    def jacobian(self, z: Array) -> Array:
        """Jacobian (samples, z) of the residuals.

        Derivatives by shared parameters and speeds are central differences of collisions, simulated in one
        batch; those by touch and travel at the touch have a closed form.
        """
        shared, n = len(self.free), len(self.impacts)
        low = self.bounds[0]
        # two points for each impact and each of its differentiated unknowns, in this order
        points: list[Array] = []
        for k in range(n):
            for j in range(shared + 1):
                index = j if j < shared else self.of_impact(k).start
                for side in (-1, 1):
                    point = z.copy()
                    point[index] = max(point[index] + side * _DIFFERENCE, low[index])
                    points.append(point)
        owner = [k for k in range(n) for _ in range(2 * (shared + 1))]
        speeds = np.array([self.speed(k, point) for k, point in zip(owner, points, strict=True)])
        histories, mass = self._histories(np.array(points)[:, :shared], speeds)
        values = [
            self._predicted(k, point, h, m, s)
            for k, point, h, m, s in zip(owner, points, histories, mass, speeds, strict=True)
        ]
        out, begin = np.zeros((sum(2 * len(i.time) for i in self.impacts), len(z))), 0
        base, base_mass = self._histories(
            np.tile(z[:shared], (n, 1)), np.array([self.speed(k, z) for k in range(n)])
        )
        for k, impact in enumerate(self.impacts):
            end, first = begin + 2 * len(impact.time), 2 * (shared + 1) * k
            for j in range(shared + 1):
                index = j if j < shared else self.of_impact(k).start
                less, more = first + 2 * j, first + 2 * j + 1
                step = points[more][index] - points[less][index]
                out[begin:end, index] = (values[more] - values[less]) / step
            out[begin:end, self.of_impact(k)][:, 1:] = self._by_touch(k, z, base[k], base_mass[k])
            begin = end
        return out

    def _by_touch(self, k: int, z: Array, history: ContactHistory, mass: float) -> Array:
        """Derivatives (2 samples, 1 or 2) of an impact's residuals by touch, and by travel at the touch."""
        impact, speed = self.impacts[k], self.speed(k, z)
        t = impact.time - self.touch(k, z)
        out = np.zeros((2 * len(t), self.per_impact - 1))
        out[: len(t), 0] = np.where(impact.clipped, 0.0, -history.slope_at(t) / self.weights.force)
        by_touch = -speed + history.impulse_at(t) / mass if impact.travels else history.force_at(t) / mass
        out[len(t) :, 0] = by_touch / self.weights.motion
        out[:, 0] *= impact.duration
        if impact.travels:
            out[len(t) :, 1] = impact.speed * impact.duration / self.weights.motion
        return out

    def solve(self, z: Array, tolerance: float) -> tuple[Array, float]:
        """Optimal z, and half its sum of squares, from an initial guess."""
        low, high = self.bounds
        edge = 1e-9 * np.minimum(high - low, 1.0)  # strictly inside the bounds
        inside = np.clip(z, low + edge, high - edge)
        found = least_squares(
            self.residuals,
            inside,
            self.jacobian,
            bounds=(low, high),
            ftol=tolerance,
            xtol=tolerance,
            gtol=None,
            max_nfev=80,
        )
        return np.asarray(found.x), float(found.cost)


def fit_law(law: ContactLaw, impacts: Sequence[MeasuredImpact], target_mass: float, level: float) -> LawFit:
    """Fits a law's parameters, the effective mass and the speeds to all impacts together.

    law : its fixed parameters are taken; of a user's law, all parameters as the initial guess.
    target_mass : [kg], infinite for a fixed target.  level : of the intervals, 0 to 1.
    """
    model = TwoMassModel(law, _MAX_DURATION * max(impact.duration for impact in impacts))
    free = free_parameters(law, impacts[0])
    names = {each.name for each in free}
    fixed = {name: value for name, value in law.parameters.items() if name not in names}
    # each impact alone, then all together from the mean of their shared parameters
    alone = [
        _fit_single(_Fit(model, free, (impact,), target_mass, _first_weights(impact), fixed))
        for impact in impacts
    ]
    weights = _Weights(*np.median([(w.force, w.motion) for w in map(_first_weights, impacts)], axis=0))
    fit = _Fit(model, free, impacts, target_mass, weights, fixed, [touch for _, touch in alone])
    shared = np.mean([z[: len(free)] for z, _ in alone], axis=0)
    z = np.concatenate([shared, *(z[len(free) :] for z, _ in alone)])
    for _ in range(_ROUNDS):
        z, _ = fit.solve(z, _FINE)
        fit.weights = _weights_of_residuals(fit, z)
    z, _ = fit.solve(z, _FINE)
    return _law_fit(law, fit, z, level)


def _touch_estimate(impact: MeasuredImpact) -> float:
    """First estimate [s] of the touch: between the last sample before contact and the first in it."""
    return float((impact.time[impact.touch - 1] + impact.time[impact.touch]) / 2)


def _first_weights(impact: MeasuredImpact) -> _Weights:
    """Weights from the noise of the samples."""
    motion = impact.speed * (impact.duration if impact.travels else 1.0)
    return _Weights(
        max(noise_of(impact.force), _MIN_NOISE * impact.peak),
        max(noise_of(impact.motion), _MIN_NOISE * motion),
    )


def _fit_single(fit: _Fit) -> tuple[Array, tuple[float, float]]:
    """Optimal z of a single impact, and the bounds [s] of its touch.

    If the law's force jumps at the touch, a residual jumps when the touch passes a sample. The problem is
    smooth only while the touch stays between two samples: each such gap near the first estimate is a fit of
    its own, and the best one is taken.
    """
    (impact,) = fit.impacts
    first = impact.time[0], impact.time[impact.touch] + 0.3 * impact.duration
    fit.touches = [first]
    z, _ = fit.solve(fit.best_of([fit.with_shared(z) for z in initial_guesses(fit.free)]), _COARSE)
    parameters = {each.name: float(each.value(z[j])) for j, each in enumerate(fit.free)}
    parameters.pop(MASS)
    law = type(fit.model.law)(**{**fit.model.law.parameters, **fit.fixed, **parameters})
    if not float(law.force(0.0, fit.speed(0, z))) > 0:  # no jump
        return z, first
    near = int(np.searchsorted(impact.time, fit.touch(0, z)))
    gaps = range(max(near - _NEIGHBOURS, 1), min(near + _NEIGHBOURS, len(impact.time) - 1) + 1)
    found = []
    for k in {*gaps, impact.touch}:
        fit.touches = [(float(impact.time[k - 1]), float(impact.time[k]))]
        found.append((*fit.solve(z, _COARSE), fit.touches[0]))
    z, _, touches = min(found, key=lambda each: each[1])
    return z, touches


# ---------------------------------------------------------------- results
def _parts(fit: _Fit, residuals: Array) -> tuple[list[Array], list[Array]]:
    """Residuals of force [N], without clipped samples, and of motion [m/s] or [m], of each impact."""
    force, motion, begin = list[Array](), list[Array](), 0
    for impact in fit.impacts:
        n = len(impact.time)
        force.append(residuals[begin : begin + n][~impact.clipped] * fit.weights.force)
        motion.append(residuals[begin + n : begin + 2 * n] * fit.weights.motion)
        begin += 2 * n
    return force, motion


def _correlation(parts: Sequence[Array]) -> float:
    """Correlation of residuals at neighbouring samples of the same impact."""
    return sum(float(r[1:] @ r[:-1]) for r in parts) / max(sum(float(r @ r) for r in parts), 1e-300)


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def _weights_of_residuals(fit: _Fit, z: Array) -> _Weights:
    """Weights from the residuals of a fit, corrected for its degrees of freedom."""
    force, motion = _parts(fit, fit.residuals(z))
    n = sum(map(len, force)) + sum(map(len, motion))
    correction = np.sqrt(n / max(n - len(z), 1))
    first = [_first_weights(impact) for impact in fit.impacts]
    min_force = _MIN_NOISE * max(impact.peak for impact in fit.impacts)
    return _Weights(
        max(correction * _rms(force), min_force),
        max(correction * _rms(motion), 1e-3 * min(weights.motion for weights in first)),
    )


def _law_fit(law: ContactLaw, fit: _Fit, z: Array, level: float) -> LawFit:
    """Result of a fit; intervals are those of its linearization, by Student's t distribution."""
    residuals, jacobian = fit.residuals(z), fit.jacobian(z)
    force, motion = _parts(fit, residuals)
    n, m, p = sum(map(len, force)), sum(map(len, motion)), len(z)
    half_width = _standard_errors(jacobian) * float(stdtrit(max(n + m - p, 1), 0.5 + level / 2))
    estimates = {}
    for each, at, half in zip(fit.free, z, half_width, strict=False):
        # the scale of a negative parameter is negative
        low, high = sorted(float(each.value(np.asarray(at + side * half))) for side in (-1, 1))
        if each.lower == 0:
            low = max(low, 0.0)
        estimates[each.name] = Estimate(float(each.value(at)), low, high, each.unit)
    speeds = []
    for k, impact in enumerate(fit.impacts):
        at, half = fit.speed(k, z), half_width[fit.of_impact(k)][0] * impact.speed
        speeds.append(Estimate(at, at - half, at + half, "m/s"))
    parameters = {name: each.value for name, each in estimates.items() if name != MASS}
    peak = max(impact.peak for impact in fit.impacts)
    largest_motion = max(
        impact.speed * (impact.duration if impact.travels else 1.0) for impact in fit.impacts
    )
    # Akaike's criterion, with the variances of force and motion unknown: each sample counts 2 log(rms)
    min_force, min_motion = _MIN_NOISE * peak, fit.weights.motion * 1e-6
    deviance = 2 * n * np.log(max(_rms(force), min_force)) + 2 * m * np.log(max(_rms(motion), min_motion))
    return LawFit(
        law=type(law)(**{**law.parameters, **parameters}),
        estimates=estimates,
        speeds=tuple(speeds),
        touches=tuple(fit.touch(k, z) for k in range(len(fit.impacts))),
        held=dict(fit.fixed),
        force_left=_rms(force),
        force_left_pct=100 * _rms(force) / peak,
        motion_left=_rms(motion),
        motion_left_pct=100 * _rms(motion) / largest_motion,
        correlation=_correlation(force),
        motion_correlation=_correlation(motion),
        aic=deviance + 2 * p,
    )


def _standard_errors(jacobian: Array) -> Array:
    """Standard errors of z, for residuals of deviation one; infinite if the samples do not determine it."""
    _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    known = s > 1e-10 * s[0]
    out = np.sqrt(np.sum((vt[known] / s[known, None]) ** 2, axis=0))
    undetermined = np.sum(vt[~known] ** 2, axis=0) > 1e-12
    return np.where(undetermined, np.inf, out)
