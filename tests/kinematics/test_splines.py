"""Splines, quintics, graded breaks and Radau's tableau: what the transcription builds on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from impactopt.kinematics.splines import (
    CubicSpline,
    Radau,
    basis,
    graded_breaks,
    knots,
    quintic,
    rate_weights,
)

Array = NDArray[np.float64]
seeds = st.integers(0, 2**31)
sizes = st.integers(1, 9)


def random_breaks(rng: np.random.Generator, intervals: int) -> Array:
    breaks = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 1.0, intervals))])
    breaks = breaks / breaks[-1]
    breaks[-1] = 1.0
    return breaks


# ---- breaks


@given(st.integers(2, 30), st.floats(1.0, 10.0), st.booleans())
def test_graded_breaks_grow_geometrically_from_the_fine_end(
    intervals: int, ratio: float, fine_end: bool
) -> None:
    breaks = graded_breaks(intervals, ratio, fine_end=fine_end)
    assert breaks.shape == (intervals + 1,)
    assert breaks[0] == 0.0
    assert breaks[-1] == 1.0
    lengths = np.diff(breaks)[::-1] if fine_end else np.diff(breaks)
    np.testing.assert_allclose(lengths[-1] / lengths[0], ratio, rtol=1e-9)
    np.testing.assert_allclose(lengths[1:] / lengths[:-1], ratio ** (1 / (intervals - 1)), rtol=1e-9)


# ---- the basis


@given(seeds, sizes)
@settings(max_examples=40, deadline=None)
def test_the_basis_is_scipys_spline_and_its_derivatives(seed: int, intervals: int) -> None:
    rng = np.random.default_rng(seed)
    breaks = random_breaks(rng, intervals)
    control = rng.standard_normal((intervals + 3, 2))
    curve = BSpline(knots(breaks), control, 3)
    s = np.sort(rng.uniform(size=7))
    value, rate, second = basis(breaks, s)
    assert value.shape == (7, intervals + 3)
    np.testing.assert_allclose(value.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(value @ control, curve(s), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rate @ control, curve.derivative(1)(s), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(second @ control, curve.derivative(2)(s), rtol=1e-8, atol=1e-8)
    h = 1e-5
    middle = np.clip(s, 2 * h, 1 - 2 * h)
    by_differences = (basis(breaks, middle + h)[0] - basis(breaks, middle - h)[0]) / (2 * h)
    np.testing.assert_allclose(basis(breaks, middle)[1], by_differences, atol=2e-4 * np.abs(rate).max())


@given(seeds, sizes)
@settings(max_examples=40, deadline=None)
def test_control_points_bound_the_curve_and_its_rate(seed: int, intervals: int) -> None:
    """Why limits on control points hold between the nodes as well."""
    rng = np.random.default_rng(seed)
    breaks = random_breaks(rng, intervals)
    control = rng.standard_normal((intervals + 3, 3))
    duration = rng.uniform(0.2, 2.0)
    curve = CubicSpline(control=control, breaks=breaks, duration=duration)
    q, v, _ = curve.sample(np.linspace(0, duration, 200))
    assert (q <= control.max(axis=0) + 1e-12).all()
    assert (q >= control.min(axis=0) - 1e-12).all()
    rates = rate_weights(breaks)[:, None] * np.diff(control, axis=0) / duration
    scale = np.abs(rates).max()
    assert (v <= rates.max(axis=0) + 1e-9 * scale).all()
    assert (v >= rates.min(axis=0) - 1e-9 * scale).all()
    np.testing.assert_allclose(v[[0, -1]], rates[[0, -1]], rtol=1e-9, atol=1e-9 * scale)


@given(seeds, sizes)
@settings(max_examples=20, deadline=None)
def test_rate_weights_give_the_control_points_of_the_derivative(seed: int, intervals: int) -> None:
    rng = np.random.default_rng(seed)
    breaks = random_breaks(rng, intervals)
    control = rng.standard_normal(intervals + 3)
    rates = rate_weights(breaks) * np.diff(control)
    s = np.linspace(0, 1, 50)
    quadratic = BSpline(knots(breaks)[1:-1], rates, 2)
    np.testing.assert_allclose(quadratic(s), basis(breaks, s)[1] @ control, rtol=1e-9, atol=1e-9)


def test_a_spline_is_smooth_to_second_order_and_exact_for_cubics() -> None:
    rng = np.random.default_rng(5)
    breaks = random_breaks(rng, 6)
    curve = CubicSpline(control=rng.standard_normal((9, 2)), breaks=breaks, duration=0.7)
    for at in breaks[1:-1] * 0.7:
        before, after = curve.sample(at - 1e-9), curve.sample(at + 1e-9)
        for a, b in zip(before, after, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)
    s = breaks[:, None]
    cubic = CubicSpline.fit(
        1 + s - 2 * s**2 + 3 * s**3, breaks, np.array([1 / 0.7]), np.array([6 / 0.7]), duration=0.7
    )
    t = np.linspace(0, 0.7, 11)
    q, v, a = (x[:, 0] for x in cubic.sample(t))
    u = t / 0.7
    np.testing.assert_allclose(q, 1 + u - 2 * u**2 + 3 * u**3, rtol=1e-12)
    np.testing.assert_allclose(v, (1 - 4 * u + 9 * u**2) / 0.7, rtol=1e-10)
    np.testing.assert_allclose(a, (-4 + 18 * u) / 0.7**2, rtol=1e-9)


def test_a_fit_goes_through_its_values_with_its_end_velocities() -> None:
    rng = np.random.default_rng(8)
    breaks = random_breaks(rng, 5)
    values, start, end = rng.standard_normal((6, 2)), rng.standard_normal(2), rng.standard_normal(2)
    curve = CubicSpline.fit(values, breaks, start, end, duration=1.3)
    np.testing.assert_allclose(curve.sample(1.3 * breaks)[0], values, atol=1e-12)
    _, v, _ = curve.sample([0, 1.3])
    np.testing.assert_allclose(v, [start, end], atol=1e-12)


def test_times_outside_the_motion_are_clipped() -> None:
    curve = CubicSpline(control=np.arange(7.0)[:, None], breaks=np.linspace(0, 1, 5), duration=2.0)
    np.testing.assert_array_equal(curve.sample([-1.0, 3.0])[0], curve.sample([0.0, 2.0])[0])


# ---- quintic


@given(seeds)
def test_a_quintic_meets_its_ends_and_has_no_acceleration_there(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, va, b, vb = rng.standard_normal((4, 2))
    duration = rng.uniform(0.3, 2.0)
    # six values make a polynomial of degree five, whose derivatives are then exact
    s = np.linspace(0, 1, 6)
    values = quintic(a, va, b, vb, duration, s)
    for k in range(2):
        poly = np.polynomial.Polynomial.fit(s, values[:, k], 5, domain=[0, 1], window=[0, 1])
        d1, d2 = poly.deriv(1), poly.deriv(2)
        np.testing.assert_allclose([poly(0), poly(1)], [a[k], b[k]], atol=1e-9)
        np.testing.assert_allclose([d1(0), d1(1)], np.array([va[k], vb[k]]) * duration, atol=1e-8)
        np.testing.assert_allclose([d2(0), d2(1)], 0, atol=1e-7)
        between = quintic(a, va, b, vb, duration, 0.37)[0, k]
        np.testing.assert_allclose(between, poly(0.37), atol=1e-9)


def test_a_quintic_from_rest_to_rest_is_the_minimum_jerk_curve() -> None:
    s = np.linspace(0, 1, 21)
    zero = np.zeros(1)
    q = quintic(zero, zero, np.ones(1), zero, 0.8, s)[:, 0]
    np.testing.assert_allclose(q, 10 * s**3 - 15 * s**4 + 6 * s**5, atol=1e-12)


# ---- Radau


@pytest.mark.parametrize("stages", [2, 3])
def test_radaus_order_conditions(stages: int) -> None:
    """B(2s-1), C(s), D(s-1) and c_s = 1 define Radau IIA (Hairer & Wanner II, section IV.5)."""
    r = Radau.of_stages(stages)
    b, c, a = r.a[-1], r.c, r.a  # stiffly accurate: the weights are the last row
    assert c[-1] == 1.0
    for p in range(1, 2 * stages):
        assert b @ c ** (p - 1) == pytest.approx(1 / p, rel=1e-13)
    for p in range(1, stages + 1):
        np.testing.assert_allclose(a @ c ** (p - 1), c**p / p, rtol=1e-12, atol=1e-15)
    for p in range(1, stages):
        np.testing.assert_allclose((b * c ** (p - 1)) @ a, b / p * (1 - c**p), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("stages", [2, 3])
def test_radau_damps_stiff_modes(stages: int) -> None:
    """R(z) -> 0: a servo far faster than the step neither rings nor grows."""
    r = Radau.of_stages(stages)
    one = np.ones(stages)
    for z in (-1e3, -1e6):
        growth = 1 + z * r.a[-1] @ np.linalg.solve(np.eye(stages) - z * r.a, one)
        assert abs(growth) < 10 / abs(z)


def test_other_radaus_are_refused() -> None:
    with pytest.raises(ValueError, match="not 4"):
        Radau.of_stages(4)
