"""Smooth distances: against coal, closed forms and differences, in C and without a compiler."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from impactopt.bodies import separation
from impactopt.bodies.convex_hulls import convex
from impactopt.bodies.separation import ROUNDING, THIN, Separations, packed, thinned

Array = NDArray[np.float64]
N = 3  # joints of chains


class Two:
    """Two hulls as `Separations` wants them, without a robot."""

    def __init__(self, one: Array, two: Array) -> None:
        self.one, self.two = one, two
        self.points, self.blocks, where = packed([one, two])
        self.hulls = np.array([[*where[0], *where[1]]], dtype=np.int64)
        self.room = np.zeros(len(self.points))

    def pair(self, turn: Array, shift: Array, way: Array | None = None, chain: Any = None) -> Separations:
        """The first so turned and shifted; chain : N placements before, and which joints turn."""
        rng_places, turns = chain or ([identity() for _ in range(N)], np.ones(N))
        numbers = np.concatenate([*rng_places, np.append(turn.ravel(), shift), turns, [0.0]])
        start = shift if way is None else way
        return Separations(self, N, np.array([0]), numbers[None], (start / np.linalg.norm(start))[None])  # type: ignore[arg-type]


def identity() -> Array:
    return np.append(np.eye(3).ravel(), np.zeros(3))


def hull(rng: Any, count: int, size: float = 0.1) -> Array:
    points = rng.uniform(-size, size, (count, 3))
    return np.asarray(points[ConvexHull(points).vertices])


def box(x: float, y: float, z: float) -> Array:
    return np.array([x, y, z]) / 2 * np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])


def turned(rng: Any) -> Array:
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return np.asarray(q if np.linalg.det(q) > 0 else -q)


def value(of: Separations, z: Array | None = None) -> float:
    out = np.zeros((1, 1))
    of.write(0, np.zeros((1, N + 3)) if z is None else z[None], out)
    return float(out[0, 0])


def gradient(of: Separations, z: Array) -> Array:
    out = np.zeros((1, N + 3))
    of.write(1, z[None], out)
    return out[0]


def hessian(of: Separations, z: Array, factor: float = 1.0) -> Array:
    rows = N + 3
    out = np.zeros((1, rows * (rows + 1) // 2))
    of.write(2, z[None], out, np.array([[factor]]))
    found = np.zeros((rows, rows))
    columns, lower = np.triu_indices(rows)
    found[lower, columns] = found[columns, lower] = out[0]
    return found


def exact(one: Array, two: Array, turn: Array, shift: Array) -> float:
    """By coal."""

    def shape(points: Array) -> Any:
        found = ConvexHull(points)
        place = np.full(len(points), -1)
        place[found.vertices] = np.arange(len(found.vertices))
        return convex(points[found.vertices], place[found.simplices])

    at, still = coal.Transform3s(turn, shift), coal.Transform3s(np.eye(3), np.zeros(3))
    return float(
        coal.distance(shape(one), at, shape(two), still, coal.DistanceRequest(), coal.DistanceResult())
    )


@pytest.fixture(params=["C", "NumPy"], autouse=True)
def made(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "NumPy":
        monkeypatch.setattr(separation, "_library", lambda: None)
    elif separation._library() is None:
        pytest.skip("no compiler")
    return str(request.param)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.05, 0.6))
def test_bodies_that_are_apart_are_so_by_their_distance_less_what_is_rounded(seed: int, far: float) -> None:
    rng = np.random.default_rng(seed)
    one, two = hull(rng, int(rng.integers(4, 40))), hull(rng, int(rng.integers(4, 40)))
    turn, way = turned(rng), rng.standard_normal(3)
    shift = far * way / np.linalg.norm(way)
    apart = exact(one, two, turn, shift)
    found = value(Two(one, two).pair(turn, shift))
    if apart > 1e-3:
        most = ROUNDING * (np.log(len(one)) + np.log(len(two)))
        assert apart - most - 1e-6 <= found <= apart + 1e-6
    else:  # in each other: no more than the least way out, which coal tells
        assert found <= apart + 1e-6


@pytest.mark.parametrize("deep", [-0.02, 0.0, 1e-4, 0.005, 0.02])
def test_sides_that_are_parallel_are_so_far_apart_as_they_are_and_bend_smoothly(deep: float) -> None:
    """Two boxes, one above the other: 4 corners each carry the side, which may turn over them."""
    one, two = box(0.1, 0.08, 0.05), box(0.3, 0.3, 0.1)
    of = Two(one, two).pair(np.eye(3), np.array([0.0, 0.0, 0.075 + deep]))
    z = np.zeros(N + 3)
    assert value(of, z) == pytest.approx(deep - 2 * ROUNDING * np.log(4), abs=1e-9)
    g, h = gradient(of, z), hessian(of, z)
    np.testing.assert_allclose(g[:3], [0, 0, 1], atol=1e-9)
    # to shift the upper one aside turns nothing, as rounding has 1 / ROUNDING of the corners' spread
    spread = (0.15**2 + 0.05**2) / ROUNDING
    assert abs(h[0, 0]) < 2 / spread and np.isfinite(h).all() and np.abs(h).max() < 10


def test_in_each_other_a_pair_knows_the_side_that_it_came_from() -> None:
    """A plate deep in another, from above or below: how deep it is from there."""
    plate = box(0.3, 0.3, 0.04)
    for side in (1.0, -1.0):
        of = Two(plate, plate).pair(np.eye(3), np.array([0.0, 0.0, 0.03 * side]), np.array([0.1, 0.0, side]))
        inside = np.zeros(N + 3)
        inside[2] = -0.05 * side  # beyond the middle
        gradient(of, np.zeros(N + 3))
        assert value(of, inside) == pytest.approx(-0.06 - 2 * ROUNDING * np.log(4), abs=1e-6)
        assert gradient(of, inside)[2] == pytest.approx(side)


def random_pair(seed: int, near: float) -> tuple[Separations, Array]:
    rng = np.random.default_rng(seed)
    places = [np.append(turned(rng).ravel(), rng.uniform(-0.1, 0.1, 3)) for _ in range(N)]
    turns = np.array([1.0, 0.0, 1.0]) if seed % 2 else np.ones(N)
    one, two = hull(rng, 20), hull(rng, 12)
    turn = turned(rng)
    z = rng.uniform(-0.3, 0.3, N + 3)
    free = Two(one, two).pair(turn, rng.uniform(-0.1, 0.1, 3), np.array([1.0, 0.0, 0.0]), (places, turns))
    # to where the two are about so near
    for _ in range(60):
        z[:3] += (near - value(free, z)) * gradient(free, z)[:3]
    return free, z


@pytest.mark.parametrize("near", [0.03, 0.005, -0.004])
@pytest.mark.parametrize("seed", range(3))
def test_derivatives_agree_with_differences(seed: int, near: float) -> None:
    of, z = random_pair(seed, near)
    g, h, step = gradient(of, z), hessian(of, z, -2.5), 1e-6
    for k in range(N + 3):
        d = np.zeros(N + 3)
        d[k] = step
        assert (value(of, z + d) - value(of, z - d)) / (2 * step) == pytest.approx(g[k], abs=1e-6)
        difference = (gradient(of, z + d) - gradient(of, z - d)) / (2 * step)
        np.testing.assert_allclose(h[k], -2.5 * difference, atol=1e-5 * np.abs(h).max() + 1e-6)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("size", [1e-3, 0.05, 0.5])
def test_a_search_that_begins_where_derivatives_foresee_finds_the_same_distance(
    seed: int, size: float
) -> None:
    """Bodies apart have one separating direction, however far the step that was foreseen."""
    of, z = random_pair(seed, 0.03)
    fresh, step = of.copy(), size * np.random.default_rng(seed).uniform(-1, 1, N + 3)
    step[:3] += 0.5 * size * gradient(of, z)[:3]  # apart rather than into each other
    expected = value(fresh, z + step)
    hessian(of, z, 0.0)
    if expected > 0:
        assert value(of, z + step) == pytest.approx(expected, abs=1e-12)


def test_values_of_trials_do_not_move_the_side_of_an_iterate() -> None:
    plate = box(0.3, 0.3, 0.04)
    of = Two(plate, plate).pair(np.eye(3), np.array([0.0, 0.0, 0.05]))
    first, beyond = np.zeros(N + 3), np.zeros(N + 3)
    beyond[2] = -0.2
    before = value(of, first)
    gradient(of, first)
    value(of, beyond)
    assert value(of, first) == before and gradient(of, first)[2] == pytest.approx(1.0)
    again = of.copy()
    assert value(again, first) == before


@pytest.mark.slow
def test_few_vertices_stand_for_many() -> None:
    rng = np.random.default_rng(3)
    ball = rng.standard_normal((2000, 3))
    ball *= 0.1 / np.linalg.norm(ball, axis=1, keepdims=True)
    few = thinned(ball)
    assert len(few) < 500
    directions = rng.standard_normal((500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    less = (directions @ ball.T).max(axis=1) - (directions @ few.T).max(axis=1)
    assert less.min() >= 0 and less.max() <= 1.5 * THIN
    assert thinned(box(1, 1, 1)) is not None and len(thinned(box(1, 1, 1))) == 8
