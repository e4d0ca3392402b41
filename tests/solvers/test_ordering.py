"""The order of elimination: every variable once, and little fill where little is needed."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from impactopt.solvers.ipm.newton import elimination_blocks


@given(seed=st.integers(0, 10**6), n=st.integers(0, 60), density=st.floats(0.0, 0.3))
@settings(max_examples=40, deadline=None)
def test_every_variable_is_in_one_block(seed: int, n: int, density: float) -> None:
    pattern = np.random.default_rng(seed).uniform(size=(n, n)) < density
    blocks = elimination_blocks(pattern | pattern.T)
    assert sorted(int(v) for block in blocks for v in block) == list(range(n))


def test_what_all_touch_is_in_one_of_the_last_two_blocks() -> None:
    pattern = np.eye(40, dtype=bool)
    pattern[7] = pattern[:, 7] = True
    assert 7 in np.concatenate(elimination_blocks(pattern)[-2:])


def test_what_touches_the_same_is_one_block() -> None:
    (block,) = elimination_blocks(np.ones((70, 70), dtype=bool))
    assert sorted(block.tolist()) == list(range(70))


def test_leaves_of_a_chain_fill_nothing() -> None:
    """Links of four variables touch the next two, and three leaves of two variables touch these; shuffled."""
    links, link, leaves, leaf = 12, 4, 3, 2
    n = links * (link + leaves * leaf)
    pattern = np.zeros((n, n), dtype=bool)
    for k in range(links):
        own = np.arange(k * link, min(links, k + 3) * link)
        pattern[np.ix_(own, own)] = True
        for i in range(leaves):
            at = links * link + (k * leaves + i) * leaf + np.arange(leaf)
            both = np.concatenate([at, own])
            pattern[np.ix_(both, both)] = True
    shuffled = np.random.default_rng(0).permutation(n)
    pattern = pattern[np.ix_(shuffled, shuffled)]
    order = np.concatenate(elimination_blocks(pattern))
    ordered = pattern[np.ix_(order, order)]
    filled = ordered.copy()
    for k in range(n):
        rows = np.flatnonzero(filled[k + 1 :, k]) + k + 1
        filled[np.ix_(rows, rows)] = True
    np.testing.assert_array_equal(filled, ordered)
