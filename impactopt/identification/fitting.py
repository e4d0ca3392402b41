"""One law's numbers by least squares on our own collision, with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import stdtrit

from impactopt.collision.sdc import VirtualMass
from impactopt.contact.laws import ContactLaw
from impactopt.contact.targets import FreeMass
from impactopt.identification.log import Blow, noise_of
from impactopt.identification.result import Estimate, LawFit
from impactopt.identification.start import MASS, Free, free_numbers, starts
from impactopt.robots.robot import Robot, Striker

__all__ = ["HEAVIEST_HAND", "Course", "Lump", "fit_law"]

Array = NDArray[np.float64]
_HEAVY = 1e6  # [kg] of the side that stands for all the rest
HEAVIEST_HAND = 1e5  # [kg]
_INSTANTS = 1500  # of a history, over its horizon
_TOLERANCE = 1e-10  # tight, as derivatives are differences of these collisions


@lru_cache(maxsize=1)
def _heavy_hand() -> Robot:
    """A mass on a slide."""
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
class Course:
    """One collision at its instants (k,): time [s] since the touch, force [N] and its slope [N/s], impulse so
    far [N s], and how far impulses have carried by then [N s2]: the integral of impulse."""

    time: Array
    force: Array
    slope: Array
    impulse: Array
    carried: Array

    def force_at(self, t: Array) -> Array:
        """[N] at times [s] since the touch; zero before and after the contact."""
        return np.interp(t, self.time, self.force, left=0.0, right=0.0)

    def slope_at(self, t: Array) -> Array:
        """[N/s]"""
        return np.interp(t, self.time, self.slope, left=0.0, right=0.0)

    def impulse_at(self, t: Array) -> Array:
        """[N s]"""
        return np.interp(t, self.time, self.impulse)

    def carried_at(self, t: Array) -> Array:
        """[N s2]; impulses go on to carry after the contact."""
        return np.interp(t, self.time, self.carried) + self.impulse[-1] * np.maximum(t - self.time[-1], 0.0)


class Lump:
    """`VirtualMass` under one contact law, with all its numbers, the mass and the speed as inputs.

    The relative motion of two free masses is that of their reduced mass against something that stays, or
    that goes on at its speed. So what varies is the mass of the *struck* side, an input of the compiled
    collision, and a hand of 1000 t goes on.

    Parameters
    ----------
    law : whose numbers are replaced.
    longest : [s] that a contact may last.
    """

    def __init__(self, law: ContactLaw, longest: float) -> None:
        # by powers of two, so that few lengths are ever compiled
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
            tolerance=_TOLERANCE,
        )

    def courses(self, numbers: Mapping[str, Array], mass: Array, speed: Array) -> list[Course]:
        """Collisions of N cases.

        numbers : of the law, (N,) each.  mass : (N,) [kg], reduced, up to `HEAVIEST_HAND`.  speed : (N,)
        [m/s] of approach.
        """
        struck = 1.0 / (1.0 / mass - 1.0 / _HEAVY)
        settings: dict[str, Any] = {f"contact_{name}": values for name, values in numbers.items()}
        found = self._model.batch(
            np.zeros((len(speed), 1)),
            speed[:, None],
            outputs=("time", "force", "target_speed", "duration"),
            threads=1,
            target_mass=struck,
            **settings,
        )
        rows = zip(found["time"], found["force"], struck[:, None] * found["target_speed"], strict=True)
        return [_course(*row) for row in rows]


def _course(time: Array, force: Array, impulse: Array) -> Course:
    if not np.isfinite(time).all():  # a collision that there is not, such as one without any force
        none = np.zeros(2)
        return Course(np.array([0.0, 1e-9]), none, none, none, none)
    last = int(np.searchsorted(time, time[-1])) + 1  # the last instant is repeated
    t, f, J = time[:last], force[:last], impulse[:last]
    steps = np.diff(t, prepend=0.0)
    carried = np.cumsum(steps * (J + np.concatenate([J[:1], J[:-1]])) / 2)
    return Course(t, f, np.gradient(f, t) if last > 1 else 0.0 * f, J, carried)


_LONGEST = 2.5  # durations of the longest contact that a search may try
_DIFFERENCE = 1e-4  # of numbers, for central differences
_ROUNDS = 2  # in which the weights of force and motion follow from what the fit has left
_CLEAN = 1e-5  # of the peak, and of the hand's motion: no log has less noise than our interpolation
_ROUGH, _FINE = 1e-5, 1e-10  # tolerances of a search among starts, and of the last one
_ABOUT = 2  # samples to each side of a first estimate between which the touch may be


@dataclass(frozen=True)
class _Weights:
    """Standard deviations: force [N], motion [m/s] or [m]."""

    force: float
    motion: float


@dataclass
class _Fit:
    """Residuals of blows that share a law and a mass; z has the shared numbers, and then those of each blow:
    speed, touch, and where travel is measured, its begin, each in its own scale."""

    lump: Lump
    free: tuple[Free, ...]
    blows: Sequence[Blow]
    target_mass: float
    weights: _Weights
    held: dict[str, float]
    touches: list[tuple[float, float]] = field(default_factory=list)  # [s] bounds of each blow's

    @property
    def own(self) -> int:
        """Numbers of each blow."""
        return 3 if self.blows[0].travels else 2

    def of_blow(self, k: int) -> slice:
        begin = len(self.free) + k * self.own
        return slice(begin, begin + self.own)

    def first(self, shared: Array) -> Array:
        """z with the shared numbers and a start for each blow."""
        return np.concatenate([shared, *(self._start_of(k) for k in range(len(self.blows)))])

    def _start_of(self, k: int) -> Array:
        low, high = self.touches[k]
        touch = self._scaled(k, np.clip(_guess(self.blows[k]), low, high))
        return np.array([1.0, touch, 0.0][: self.own])

    def _scaled(self, k: int, touch: float) -> float:
        return float((touch - _guess(self.blows[k])) / self.blows[k].duration)

    def _touch(self, k: int, z: Array) -> float:
        return float(_guess(self.blows[k]) + z[self.of_blow(k)][1] * self.blows[k].duration)

    @property
    def bounds(self) -> tuple[Array, Array]:
        low = [each.lower for each in self.free]
        high = [each.upper for each in self.free]
        high[-1] = min(high[-1], float(np.log(0.5 * HEAVIEST_HAND / self.free[-1].scale)))
        for k in range(len(self.blows)):
            places = [self._scaled(k, touch) for touch in self.touches[k]]
            low += [0.1, places[0], -np.inf][: self.own]
            high += [10.0, places[1], np.inf][: self.own]
        return np.array(low), np.array(high)

    # ------------------------------------------------------------ collisions
    def _courses(self, shared: Array, speed: Array) -> tuple[list[Course], Array]:
        """Collisions and masses [kg] of rows (N, shared) at speeds (N,)."""
        numbers = {each.name: each.number(z) for each, z in zip(self.free, shared.T, strict=True)}
        mass = numbers.pop(MASS)
        numbers |= {name: np.full(len(shared), value) for name, value in self.held.items()}
        return self.lump.courses(numbers, 1.0 / (1.0 / mass + 1.0 / self.target_mass), speed), mass

    def _at(self, k: int, z: Array, course: Course, mass: float, speed: float) -> Array:
        """Force and motion of one blow at its samples, weighted."""
        blow = self.blows[k]
        t = blow.time - self._touch(k, z)
        if blow.travels:
            begin = z[self.of_blow(k)][2] * blow.speed * blow.duration + blow.motion[blow.touch]
            motion = begin + speed * t - course.carried_at(t) / mass
        else:
            motion = speed - course.impulse_at(t) / mass
        force = np.where(blow.clipped, 0.0, course.force_at(t))
        return np.concatenate([force / self.weights.force, motion / self.weights.motion])

    def _speed(self, k: int, z: Array) -> float:
        return float(z[self.of_blow(k)][0] * self.blows[k].speed)

    def measured(self) -> Array:
        both = [
            (np.where(b.clipped, 0.0, b.force) / self.weights.force, b.motion / self.weights.motion)
            for b in self.blows
        ]
        return np.concatenate([part for pair in both for part in pair])

    def residuals(self, z: Array) -> Array:
        n = len(self.blows)
        speeds = np.array([self._speed(k, z) for k in range(n)])
        courses, mass = self._courses(np.tile(z[: len(self.free)], (n, 1)), speeds)
        return (
            np.concatenate([self._at(k, z, courses[k], mass[k], speeds[k]) for k in range(n)])
            - self.measured()
        )

    def best_of(self, tried: Sequence[Array]) -> Array:
        """The z of least squares for the first blow."""
        speeds = np.array([self._speed(0, z) for z in tried])
        courses, mass = self._courses(np.array(tried)[:, : len(self.free)], speeds)
        rows = zip(tried, courses, mass, speeds, strict=True)
        measured = self.measured()[: 2 * len(self.blows[0].time)]
        costs = [float(np.sum((self._at(0, *row) - measured) ** 2)) for row in rows]
        return tried[int(np.argmin(costs))]

    def jacobian(self, z: Array) -> Array:
        """(samples, z): by central differences of collisions; by the touch, and by where travel begins,
        in closed form."""
        shared, n = len(self.free), len(self.blows)
        low = self.bounds[0]
        rows: list[Array] = []
        for k in range(n):
            for j in range(shared + 1):
                place = j if j < shared else self.of_blow(k).start
                for side in (-1, 1):
                    moved = z.copy()
                    moved[place] = max(moved[place] + side * _DIFFERENCE, low[place])
                    rows.append(moved)
        owner = [k for k in range(n) for _ in range(2 * (shared + 1))]
        speeds = np.array([self._speed(k, row) for k, row in zip(owner, rows, strict=True)])
        courses, mass = self._courses(np.array(rows)[:, :shared], speeds)
        values = [
            self._at(k, row, c, m, s)
            for k, row, c, m, s in zip(owner, rows, courses, mass, speeds, strict=True)
        ]
        blocks, begin = np.zeros((sum(2 * len(b.time) for b in self.blows), len(z))), 0
        base, base_mass = self._courses(
            np.tile(z[:shared], (n, 1)), np.array([self._speed(k, z) for k in range(n)])
        )
        for k, blow in enumerate(self.blows):
            end, at = begin + 2 * len(blow.time), 2 * (shared + 1) * k
            for j in range(shared + 1):
                place = j if j < shared else self.of_blow(k).start
                less, more = at + 2 * j, at + 2 * j + 1
                step = rows[more][place] - rows[less][place]
                blocks[begin:end, place] = (values[more] - values[less]) / step
            blocks[begin:end, self.of_blow(k)][:, 1:] = self._in_time(k, z, base[k], base_mass[k])
            begin = end
        return blocks

    def _in_time(self, k: int, z: Array, course: Course, mass: float) -> Array:
        blow, speed = self.blows[k], self._speed(k, z)
        t = blow.time - self._touch(k, z)
        out = np.zeros((2 * len(t), self.own - 1))
        out[: len(t), 0] = np.where(blow.clipped, 0.0, -course.slope_at(t) / self.weights.force)
        moves = -speed + course.impulse_at(t) / mass if blow.travels else course.force_at(t) / mass
        out[len(t) :, 0] = moves / self.weights.motion
        out[:, 0] *= blow.duration
        if blow.travels:
            out[len(t) :, 1] = blow.speed * blow.duration / self.weights.motion
        return out

    def solve(self, z: Array, tolerance: float) -> tuple[Array, float]:
        """The best z, and half its sum of squares."""
        low, high = self.bounds
        edge = 1e-9 * np.minimum(high - low, 1.0)
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


def fit_law(law: ContactLaw, blows: Sequence[Blow], target_mass: float, level: float) -> LawFit:
    """The numbers of a law, the effective mass and the speeds that fit all blows together best.

    law : its held numbers, and of one's own law all as a start.  target_mass : [kg], infinite for a target
    that stays.  level : of the intervals, 0 to 1.
    """
    lump = Lump(law, _LONGEST * max(blow.duration for blow in blows))
    free = free_numbers(law, blows[0])
    names = {each.name for each in free}
    held = {name: value for name, value in law.parameters.items() if name not in names}
    alone = [_alone(_Fit(lump, free, (blow,), target_mass, _first_weights(blow), held)) for blow in blows]
    weights = _Weights(*np.median([(w.force, w.motion) for w in map(_first_weights, blows)], axis=0))
    fit = _Fit(lump, free, blows, target_mass, weights, held, [touch for _, touch in alone])
    shared = np.mean([z[: len(free)] for z, _ in alone], axis=0)
    z = np.concatenate([shared, *(z[len(free) :] for z, _ in alone)])
    for _ in range(_ROUNDS):
        z, _ = fit.solve(z, _FINE)
        fit.weights = _weights_left(fit, z)
    z, _ = fit.solve(z, _FINE)
    return _told(law, fit, z, level)


def _guess(blow: Blow) -> float:
    """[s] of the touch."""
    return float((blow.time[blow.touch - 1] + blow.time[blow.touch]) / 2)


def _first_weights(blow: Blow) -> _Weights:
    moved = blow.speed * (blow.duration if blow.travels else 1.0)
    return _Weights(max(noise_of(blow.force), _CLEAN * blow.peak), max(noise_of(blow.motion), _CLEAN * moved))


def _alone(fit: _Fit) -> tuple[Array, tuple[float, float]]:
    """z of a single blow, and the bounds [s] within which its touch is.

    A force that jumps at the touch has a residual that jumps where the touch passes a sample. So each gap
    between two samples is a search of its own, and smooth.
    """
    (blow,) = fit.blows
    first = blow.time[0], blow.time[blow.touch] + 0.3 * blow.duration
    fit.touches = [first]
    z, _ = fit.solve(fit.best_of([fit.first(z) for z in starts(fit.free)]), _ROUGH)
    numbers = {each.name: float(each.number(z[j])) for j, each in enumerate(fit.free)}
    numbers.pop(MASS)
    law = type(fit.lump.law)(**{**fit.lump.law.parameters, **fit.held, **numbers})
    if not float(law.force(0.0, fit._speed(0, z))) > 0:
        return z, first
    near = int(np.searchsorted(blow.time, fit._touch(0, z)))
    gaps = range(max(near - _ABOUT, 1), min(near + _ABOUT, len(blow.time) - 1) + 1)
    found = []
    for k in {*gaps, blow.touch}:
        fit.touches = [(float(blow.time[k - 1]), float(blow.time[k]))]
        found.append((*fit.solve(z, _ROUGH), fit.touches[0]))
    z, _, touches = min(found, key=lambda each: each[1])
    return z, touches


# ---------------------------------------------------------------- what is reported
def _parts(fit: _Fit, residuals: Array) -> tuple[Array, Array]:
    """Residuals of force [N], without clipped samples, and of motion [m/s] or [m], all blows."""
    force, motion, begin = [], [], 0
    for blow in fit.blows:
        n = len(blow.time)
        force.append(residuals[begin : begin + n][~blow.clipped] * fit.weights.force)
        motion.append(residuals[begin + n : begin + 2 * n] * fit.weights.motion)
        begin += 2 * n
    return np.concatenate(force), np.concatenate(motion)


def _correlation(fit: _Fit, force: Array) -> float:
    """Correlation of the force's residuals at neighbouring samples."""
    ends = np.cumsum([np.sum(~blow.clipped) for blow in fit.blows])[:-1]
    together = sum(float(r[1:] @ r[:-1]) for r in np.split(force, ends))
    return together / max(float(force @ force), 1e-300)


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _weights_left(fit: _Fit, z: Array) -> _Weights:
    force, motion = _parts(fit, fit.residuals(z))
    n = len(force) + len(motion)
    spread = np.sqrt(n / max(n - len(z), 1))
    least = [_first_weights(blow) for blow in fit.blows]
    clean = _CLEAN * max(blow.peak for blow in fit.blows)
    return _Weights(
        max(spread * _rms(force), clean),
        max(spread * _rms(motion), 1e-3 * min(weights.motion for weights in least)),
    )


def _told(law: ContactLaw, fit: _Fit, z: Array, level: float) -> LawFit:
    residuals, jacobian = fit.residuals(z), fit.jacobian(z)
    force, motion = _parts(fit, residuals)
    n, m, p = len(force), len(motion), len(z)
    spread = _standard_errors(jacobian) * float(stdtrit(max(n + m - p, 1), 0.5 + level / 2))
    estimates = {}
    for each, at, off in zip(fit.free, z, spread, strict=False):
        low, high = (float(each.number(np.asarray(at + side * off))) for side in (-1, 1))
        if not each.logarithmic:
            low = max(low, 0.0) if each.lower == 0 else min(low, high)
        estimates[each.name] = Estimate(float(each.number(at)), low, max(low, high), each.unit)
    speeds = []
    for k, blow in enumerate(fit.blows):
        at, off = fit._speed(k, z), spread[fit.of_blow(k)][0] * blow.speed
        speeds.append(Estimate(at, at - off, at + off, "m/s"))
    numbers = {name: each.value for name, each in estimates.items() if name != MASS}
    peak = max(blow.peak for blow in fit.blows)
    floor = (_CLEAN * peak, fit.weights.motion * 1e-6)
    left = 2 * n * np.log(max(_rms(force), floor[0])) + 2 * m * np.log(max(_rms(motion), floor[1]))
    return LawFit(
        law=type(law)(**{**law.parameters, **numbers}),
        estimates=estimates,
        speeds=tuple(speeds),
        touches=tuple(fit._touch(k, z) for k in range(len(fit.blows))),
        held=dict(fit.held),
        force_left=_rms(force),
        force_left_pct=100 * _rms(force) / peak,
        motion_left=_rms(motion),
        correlation=_correlation(fit, force),
        aic=left + 2 * p,
    )


def _standard_errors(jacobian: Array) -> Array:
    """Standard errors of z, for residuals of deviation one; infinite if the samples do not determine it."""
    _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    known = s > 1e-10 * s[0]
    out = np.sqrt(np.sum((vt[known] / s[known, None]) ** 2, axis=0))
    lost = np.sum(vt[~known] ** 2, axis=0) > 1e-12
    return np.where(lost, np.inf, out)
