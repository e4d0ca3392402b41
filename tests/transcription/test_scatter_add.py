"""Scatter-adds in runs, in C and by sparse products, against sums one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impactopt.transcription import structured as scatter_add
from impactopt.transcription.structured import Runs, count_up, union, with_transposed

seeds = st.integers(0, 2**31)


@pytest.fixture(scope="module", autouse=True)
def _loaded() -> None:
    """Compiled and loaded before Hypothesis times an example."""
    scatter_add._library()


@given(seeds, st.booleans())
def test_runs_against_sums_one_by_one(seed: int, compiled: bool) -> None:
    rng = np.random.default_rng(seed)
    count, entries, size = int(rng.integers(0, 9)), rng.standard_normal(20), 30
    length = rng.integers(0, 6, count)
    source, destination = rng.integers(0, 14, count), rng.integers(0, 24, count)
    factor, out = rng.standard_normal(count), rng.standard_normal(size)
    expected = out.copy()
    for e, p, n, f in zip(source, destination, length, factor, strict=True):
        for i in range(n):
            expected[p + i] += f * entries[e + i]
    with pytest.MonkeyPatch.context() as patch:
        if not compiled:
            patch.setattr(scatter_add, "_library", lambda: None)
        Runs.make(source, destination, length, factor, (size, entries.size)).add_to(out, entries)
    np.testing.assert_allclose(out, expected, atol=1e-12)


@given(seeds, st.booleans())
def test_a_matrix_and_its_transpose(seed: int, compiled: bool) -> None:
    matrix = np.random.default_rng(seed).standard_normal((4, 4))
    across = np.arange(16, dtype=np.int32).reshape(4, 4).T.ravel()
    with pytest.MonkeyPatch.context() as patch:
        if not compiled:
            patch.setattr(scatter_add, "_library", lambda: None)
        both = with_transposed(matrix.ravel(), across)
    np.testing.assert_array_equal(both.reshape(4, 4), matrix + matrix.T)


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(1, 8)), max_size=12))
def test_union_lists_each_number_once(parts: list[tuple[int, int]]) -> None:
    first, length = (np.array([p[k] for p in parts], dtype=np.intp) for k in range(2))
    numbers = sorted({a + i for a, n in parts for i in range(n)})
    assert union(first, length).tolist() == numbers


def test_count_up() -> None:
    assert count_up(np.array([2, 0, 3])).tolist() == [0, 1, 0, 1, 2]
    assert count_up(np.zeros(0, dtype=np.intp)).size == 0
