"""The contact wrench cone against Caron and against corner forces; margins; support polygon and ZMP."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog

from impactopt import InputError
from impactopt.kinematics.stance import contact_wrench_cone, margin, shrink, support_polygon, zmp

Array = NDArray[np.float64]
seeds = st.integers(0, 2**31)
RECTANGLE = np.array([[0.11, 0.06], [-0.11, 0.06], [-0.11, -0.06], [0.11, -0.06]])


def random_polygon(rng: np.random.Generator, corners: int) -> Array:
    """Convex, counter-clockwise, of a foot's size, and not about the frame's origin."""
    gaps = 1 + rng.uniform(size=corners)  # none so large that an edge goes half way round
    angle = rng.uniform(0, 2 * np.pi) + np.cumsum(gaps / gaps.sum() * 2 * np.pi)
    ellipse = np.stack(
        [rng.uniform(0.08, 0.14) * np.cos(angle), rng.uniform(0.04, 0.08) * np.sin(angle)], axis=1
    )
    return ellipse + rng.uniform(-0.03, 0.03, size=2)


def corner_rays(polygon: Array, friction: float) -> Array:
    """(6, 4 k) wrenches of the friction pyramids' edges at the corners."""
    rays = []
    for x, y in polygon:
        for a in (friction, -friction):
            for b in (friction, -friction):
                force = np.array([a, b, 1.0])
                rays.append(np.concatenate([force, np.cross([x, y, 0.0], force)]))
    return np.array(rays).T


def depth(polygon: Array, points: Array) -> Array:
    """Distance inside the nearest edge, by cross products."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    arm = points[:, None, :] - polygon
    cross = edge[:, 0] * arm[..., 1] - edge[:, 1] * arm[..., 0]
    return np.asarray((cross / np.hypot(*edge.T)).min(axis=1))


# ---- the cone


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_torsion_and_cop_bounds_are_carons_closed_form_for_a_rectangle(seed: int) -> None:
    """For given (f, m_x, m_y) the cone leaves exactly the interval of m_z of Caron et al. 2015."""
    rng = np.random.default_rng(seed)
    long, wide, mu = rng.uniform(0.05, 0.15), rng.uniform(0.03, 0.08), rng.uniform(0.2, 1.2)
    facets = contact_wrench_cone([[long, wide], [-long, wide], [-long, -wide], [long, -wide]], mu)
    fz = rng.uniform(100, 900)
    for _ in range(20):
        fx, fy = rng.uniform(-1.2, 1.2, size=2) * mu * fz
        mx, my = rng.uniform(-1.2, 1.2) * wide * fz, rng.uniform(-1.2, 1.2) * long * fz
        rest = facets[:, :5] @ [fx, fy, fz, mx, my]
        k = facets[:, 5]
        tol = 1e-12
        low = float(np.max(-rest[k > tol] / k[k > tol]))
        high = float(np.min(-rest[k < -tol] / k[k < -tol]))
        flat = rest[np.abs(k) <= tol]
        least = -mu * (long + wide) * fz + abs(wide * fx - mu * mx) + abs(long * fy - mu * my)
        most = mu * (long + wide) * fz - abs(wide * fx + mu * mx) - abs(long * fy + mu * my)
        np.testing.assert_allclose([low, high], [least, most], rtol=1e-9, atol=1e-9 * fz)
        inside = abs(fx) <= mu * fz and abs(fy) <= mu * fz and abs(mx) <= wide * fz and abs(my) <= long * fz
        assert bool((flat >= 0).all() and low <= high) == (inside and least <= most)


@given(seeds, st.integers(3, 8))
@settings(max_examples=60, deadline=None)
def test_a_wrench_is_in_the_cone_if_and_only_if_corner_forces_make_it(seed: int, corners: int) -> None:
    rng = np.random.default_rng(seed)
    mu = rng.uniform(0.3, 1.0)
    polygon = random_polygon(rng, corners)
    facets, rays = contact_wrench_cone(polygon, mu), corner_rays(polygon, mu)
    middle = rays.mean(axis=1)
    some = rays @ rng.dirichlet(np.full(rays.shape[1], 0.2))
    # a wrench of the cone, pushed out of it (or not) along a random direction
    size = np.array([mu, mu, 1, 0.1, 0.1, 0.1])
    wrench = some + rng.uniform(0, 0.5) * size * rng.standard_normal(6)
    for w in (some, middle, wrench):
        value = float((facets @ w).min())
        if abs(value) < 1e-9:
            continue
        answer = linprog(np.zeros(rays.shape[1]), A_eq=rays, b_eq=w, bounds=(0, None), method="highs")
        assert (value > 0) == (answer.status == 0)
    assert (facets @ some).min() > -1e-12
    assert (facets @ middle).min() > 1e-3  # scaled: well inside is of the order of one
    assert (facets @ -middle).min() < 0


def test_the_cone_is_a_cone_about_the_normal_force() -> None:
    facets = contact_wrench_cone(RECTANGLE, 0.7)
    push = np.array([0, 0, 1, 0, 0, 0.0])
    assert (facets @ push > 0).all()
    assert (facets @ -push < 0).all()
    np.testing.assert_array_equal(facets @ np.zeros(6), 0)


def test_torsion_vanishes_at_a_corner_and_is_largest_in_the_middle() -> None:
    """Why the three cannot be bounded one by one."""
    facets, mu = contact_wrench_cone(RECTANGLE, 0.5), 0.5

    def torsion(x: float, y: float) -> float:
        lever = np.array([0, 0, 1, y, -x, 0])
        slope = facets[:, 5]
        return float(np.min((facets @ lever)[slope < -1e-12] / -slope[slope < -1e-12]))

    assert torsion(0, 0) == pytest.approx(mu * (0.11 + 0.06))
    assert torsion(0.11, 0.06) == pytest.approx(0, abs=1e-9)
    assert 0.005 < torsion(0.1, 0.05) < torsion(0.05, 0.03) < torsion(0, 0)


@given(seeds, st.integers(3, 8), st.floats(0, 0.015))
@settings(max_examples=60, deadline=None)
def test_a_margin_keeps_the_cop_that_far_from_every_edge(seed: int, corners: int, keep: float) -> None:
    rng = np.random.default_rng(seed)
    polygon = random_polygon(rng, corners)
    facets = contact_wrench_cone(polygon, 0.6, margin=keep)
    points = polygon.mean(axis=0) + rng.uniform(-0.15, 0.15, size=(40, 2))
    far = depth(polygon, points) - keep
    for (x, y), inside in zip(points, far, strict=True):
        if abs(inside) > 1e-6:
            assert bool((facets @ [0, 0, 1, y, -x, 0]).min() > 0) == (inside > 0)


@pytest.mark.parametrize("friction", [0.0, -0.5, np.nan])
def test_friction_has_to_be_positive(friction: float) -> None:
    with pytest.raises(InputError, match="friction"):
        contact_wrench_cone(RECTANGLE, friction)


def test_a_polygon_without_area_is_refused() -> None:
    line = np.array([[0.1, 0.0], [0.0, 0.0], [-0.1, 0.0]])
    with pytest.raises(InputError, match="degenerate"):
        contact_wrench_cone(line, 0.6)
    with pytest.raises(InputError, match="sole"):
        contact_wrench_cone(line, 0.6, margin=0.01)


# ---- shrinking


@given(seeds, st.integers(3, 8), st.floats(0.001, 0.03))
@settings(max_examples=100, deadline=None)
def test_a_shrunk_polygon_is_the_points_that_far_inside(seed: int, corners: int, by: float) -> None:
    rng = np.random.default_rng(seed)
    polygon = random_polygon(rng, corners)
    points = polygon.mean(axis=0) + rng.uniform(-0.15, 0.15, size=(200, 2))
    wanted = depth(polygon, points) - by
    try:
        small = shrink(polygon, by)
    except InputError:
        assert (wanted < 1e-6).all()
        return
    np.testing.assert_allclose(depth(polygon, small), by, atol=1e-9)  # corners are where two moved edges meet
    clear = np.abs(wanted) > 1e-6
    np.testing.assert_array_equal((depth(small, points) > 0)[clear], (wanted > 0)[clear])


def test_a_margin_may_swallow_a_chamfer_but_not_the_sole() -> None:
    chamfered = [[0.1, 0.04], [0.09, 0.05], [-0.1, 0.05], [-0.1, -0.05], [0.1, -0.05]]
    small = shrink(chamfered, 0.03)
    np.testing.assert_allclose(
        small[np.lexsort(small.T)], [[-0.07, -0.02], [0.07, -0.02], [-0.07, 0.02], [0.07, 0.02]]
    )
    with pytest.raises(InputError, match=r"0\.05 m leaves nothing"):
        shrink(chamfered, 0.05)
    with pytest.raises(InputError, match="leaves nothing"):
        shrink(chamfered, 1.0)


def test_no_margin_leaves_the_polygon_alone() -> None:
    same = shrink(RECTANGLE, 0.0)
    np.testing.assert_array_equal(same, RECTANGLE)
    same[0] = 9
    assert RECTANGLE[0, 0] == 0.11


# ---- support polygon, ZMP


def stance(*placements: Any) -> Any:
    sole = SimpleNamespace(polygon=RECTANGLE)
    return SimpleNamespace(legs=[SimpleNamespace(placement=m, sole=sole) for m in placements])


def test_the_support_polygon_is_the_hull_of_the_soles_counter_clockwise() -> None:
    turn = pin.utils.rotate("z", 0.3)
    left = pin.SE3(np.eye(3), np.array([0.0, 0.1, 0.0]))
    right = pin.SE3(turn, np.array([0.05, -0.1, 0.0]))
    polygon = support_polygon(None, stance(left, right))
    corners = np.vstack([(m.rotation[:2, :2] @ RECTANGLE.T).T + m.translation[:2] for m in (left, right)])
    assert margin(polygon, corners).min() > -1e-12
    for p in polygon:
        assert np.abs(corners - p).sum(axis=1).min() < 1e-12
    edge = np.roll(polygon, -1, axis=0) - polygon
    assert (
        edge[:, 0] * np.roll(edge, -1, axis=0)[:, 1] - edge[:, 1] * np.roll(edge, -1, axis=0)[:, 0] > 0
    ).all()
    assert support_polygon(None, stance()).shape == (0, 2)


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-9])
def test_corners_in_line_do_not_depend_on_rounding(noise: float) -> None:
    """Soles side by side: the corners in the middle of the long edges must not come and go."""
    rng = np.random.default_rng(1)
    for _ in range(10):
        shifts = noise * rng.standard_normal((2, 3))
        places = [
            pin.SE3(np.eye(3), np.array([0.0, y, 0.0]) + s) for y, s in zip((0.1, -0.1), shifts, strict=True)
        ]
        assert len(support_polygon(None, stance(*places))) == 4


@given(seeds, st.integers(3, 8))
@settings(max_examples=30, deadline=None)
def test_the_margin_is_the_distance_inside_the_nearest_edge(seed: int, corners: int) -> None:
    rng = np.random.default_rng(seed)
    polygon, points = random_polygon(rng, corners), rng.uniform(-0.2, 0.2, size=(20, 2))
    np.testing.assert_allclose(margin(polygon, points), depth(polygon, points), atol=1e-12)


def test_the_zmp_has_no_horizontal_moment() -> None:
    rng = np.random.default_rng(3)
    wrench = rng.standard_normal((5, 6)) * 50 + np.array([0, 0, 400, 0, 0, 0])
    for w, (x, y) in zip(wrench, zmp(wrench), strict=True):
        about = w[3:] - np.cross([x, y, 0.0], w[:3])
        np.testing.assert_allclose(about[:2], 0, atol=1e-9)
    np.testing.assert_allclose(zmp(np.array([0, 0, 10.0, 2.0, -3.0, 0])), [[0.3, 0.2]])
