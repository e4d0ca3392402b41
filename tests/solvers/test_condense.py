"""Condensed Newton systems against the full ones, solved densely."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg as la
import scipy.sparse as sp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from impactopt.solvers.elimination.condense import Condenser, Elimination, find_eliminations
from impactopt.solvers.elimination.kernels import Kernels, kernels
from impactopt.solvers.ipm.newton import BlockCholesky, NewtonSystem, acquire, release
from impactopt.solvers.program import Determined
from impactopt.transcription.initial_guess import first_iterate

NONE = np.zeros(9, dtype=bool)


def chained(seed, systems=4, own=2, shared=3):
    """Jacobian, Hessian, eliminations: each system's equalities contain its own and the shared variables."""
    rng = np.random.default_rng(seed)
    n = systems * own + shared
    J = np.zeros((systems * own + 5, n))
    for k in range(systems):
        mine = slice(k * own, (k + 1) * own)
        J[mine, mine] = rng.normal(size=(own, own)) + 3 * np.eye(own)
        J[mine, systems * own :] = rng.normal(size=(own, shared))
    J[systems * own :, systems * own :] = rng.normal(size=(5, shared))
    J[systems * own, :own] = rng.normal(size=own)  # constraints that contain eliminated variables
    J[systems * own + 1, own : 2 * own] = rng.normal(size=own)
    H = rng.normal(size=(n, n))
    H = H @ H.T + np.eye(n)
    for k in range(systems):  # coupled to the shared ones, not to each other
        mine = np.arange(k * own, (k + 1) * own)
        others = np.setdiff1d(np.arange(systems * own), mine)
        H[np.ix_(mine, others)] = 0.0
    H = sp.csc_array(H + 20 * np.eye(n))
    numbers = np.arange(systems * own).reshape(systems, own)
    return sp.csc_array(J), H, [Elimination(numbers, numbers)], rng


@pytest.fixture(params=[Kernels, kernels], ids=["numpy", "compiled"])
def algebra(request):
    return request.param()


# systems of few equalities, of six, and of so many that C leaves them to BLAS
@given(
    seed=st.integers(0, 10**6),
    own=st.sampled_from([2, 6, 8, 9]),
    hard=st.booleans(),
    indefinite=st.booleans(),
)
@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_condensed_step_is_the_whole_one(algebra, seed, own, hard, indefinite):
    J, H, eliminations, rng = chained(seed, own=own)
    m, n = J.shape
    if indefinite:
        H = sp.csc_array(H - 60 * sp.diags_array(1.0 * (np.arange(n) == n - 1)))
    equal = np.zeros(m, dtype=bool)
    equal[eliminations[0].constraints.ravel()] = equal[m - 5] = True
    bounded = np.zeros(n, dtype=bool)
    bounded[[0, n - 1]] = True
    c = Condenser(J, H, eliminations, equal, bounded, algebra)
    assert c.bounded.tolist() == [0]
    assert c.remaining[c.equal].tolist() == [m - 5]
    gradient, residual = rng.normal(size=n), rng.normal(size=c.m)
    weights, diagonal = 0.1 + rng.random(c.remaining.size), rng.random(c.free.size)
    newton = NewtonSystem(c, np.zeros(0, dtype=int), algebra)
    assert newton.factor(J, H, diagonal, lambda _: weights.copy(), hard=hard)
    step, y = newton.solve(gradient, residual)
    # the full system: equalities J_e d = -r_e, other constraints y = w (J d + r), stationarity
    rows = np.vstack([J.toarray(), np.eye(n)[[0]]])
    softness = np.zeros(c.m)
    softness[c.remaining] = 1.0 / weights
    if hard:
        softness[m - 5] = 0.0
    whole = H.toarray() + newton.shift * np.eye(n)
    whole[c.free, c.free] += diagonal
    system = np.block([[whole, rows.T], [rows, -np.diag(softness)]])
    exact = np.linalg.solve(system, -np.concatenate([gradient, residual]))
    np.testing.assert_allclose(step, exact[:n], atol=1e-8 * (1 + np.abs(exact).max()))
    np.testing.assert_allclose(y, exact[n:], atol=1e-8 * (1 + np.abs(exact).max()))
    # inertia: as many negative eigenvalues as constraints, also if the Hessian is indefinite
    hard_rows = np.flatnonzero(softness == 0.0)
    Z = la.null_space(rows[hard_rows])
    soft = np.setdiff1d(np.arange(c.m), hard_rows)
    reduced = Z.T @ (whole + rows[soft].T / softness[soft] @ rows[soft]) @ Z
    assert np.linalg.eigvalsh(reduced).min() > 0.0


def test_a_variable_that_is_held_does_not_move(algebra):
    J, H, eliminations, rng = chained(3)
    equal, bounded = np.zeros(J.shape[0], dtype=bool), np.zeros(J.shape[1], dtype=bool)
    equal[eliminations[0].constraints.ravel()] = True
    c = Condenser(J, H, eliminations, equal, bounded, algebra)
    newton = NewtonSystem(c, np.array([1]), algebra)
    assert newton.factor(J, H, np.zeros(c.free.size), lambda _: np.ones(c.remaining.size), hard=True)
    step, _ = newton.solve(rng.normal(size=J.shape[1]), rng.normal(size=c.m))
    assert step[c.free[1]] == 0.0
    assert np.abs(step).min(initial=1.0, where=np.arange(step.size) != c.free[1]) > 0.0


@pytest.mark.parametrize("seed", [0, 2])
def test_a_steep_hessian_costs_no_digits(algebra, seed):
    """The weight of the equalities left follows its curvature, and hides what the others curve."""
    J, H, eliminations, rng = chained(seed)
    (m, n), equal = J.shape, np.zeros(J.shape[0], dtype=bool)
    H = sp.csc_array(H + 1e7 * sp.diags_array(1.0 * (np.arange(n) == n - 1)))
    equal[eliminations[0].constraints.ravel()] = equal[m - 5 : m - 3] = True
    c = Condenser(J, H, eliminations, equal, np.zeros(n, dtype=bool), algebra)
    newton = NewtonSystem(c, np.zeros(0, dtype=int), algebra)
    assert newton.factor(J, H, np.zeros(c.free.size), lambda _: np.ones(c.remaining.size), hard=True)
    gradient, residual = rng.normal(size=n), rng.normal(size=m)
    step, y = newton.solve(gradient, residual)
    np.testing.assert_allclose(gradient + H @ step + newton.shift * step + J.T @ y, 0, atol=1e-11)
    np.testing.assert_allclose((J @ step + residual)[equal], 0, atol=1e-12)


@pytest.mark.parametrize("ties", [False, True])
def test_a_structure_serves_programs_with_other_inequalities(ties):
    """Where these couple what is coupled anyway; it gets another one where they tie two systems together."""
    J, H, eliminations, rng = chained(7)
    m, n = J.shape
    new = np.zeros((2, n))
    new[0, [n - 3, n - 1]] = new[1, [0, 2 if ties else n - 2]] = rng.normal(size=2)
    dense = J.toarray()
    more = sp.csc_array(np.vstack([new[:1], dense, new[1:]]))
    determined = [Determined((0,), variables) for variables in eliminations[0].variables]
    systems, bounded = [], np.zeros(n, dtype=bool)
    for matrix, before in ((J, 0), (more, 1)):
        equal = np.zeros(matrix.shape[0], dtype=bool)
        equal[before + eliminations[0].constraints.ravel()] = equal[before + m - 5] = True
        given = {"determined": determined, "equal": equal, "bounded": bounded, "moves": ~bounded}
        systems.append(acquire(matrix, H, **given))
        release(systems[-1])
    assert (systems[0] is systems[1]) is not ties
    newton, c = systems[1], systems[1].condenser
    weights, gradient, residual = (
        0.1 + rng.random(c.remaining.size),
        rng.normal(size=n),
        rng.normal(size=m + 2),
    )
    assert newton.factor(more, H, np.zeros(c.free.size), lambda _: weights.copy(), hard=True)
    step, y = newton.solve(gradient, residual)
    softness = np.zeros(m + 2)
    softness[c.remaining] = 1.0 / weights
    softness[equal] = 0.0
    dense = more.toarray()
    system = np.block([[H.toarray() + newton.shift * np.eye(n), dense.T], [dense, -np.diag(softness)]])
    exact = np.linalg.solve(system, -np.concatenate([gradient, residual]))
    np.testing.assert_allclose(step, exact[:n], atol=1e-8 * (1 + np.abs(exact).max()))
    np.testing.assert_allclose(y, exact[n:], atol=1e-8 * (1 + np.abs(exact).max()))


@pytest.mark.parametrize("tie", ["row", "equality", "hessian", "own row"])
def test_systems_that_are_tied_to_each_other_go_one_after_the_other(algebra, tie):
    """By a row that touches both, soft or hard, by the Hessian, or as one's rows touch the other's variables:
    as torques of neighbouring nodes are by a limit of their rate."""
    J, H, eliminations, rng = chained(5)
    (m, n), dense, curved = J.shape, J.toarray(), H.toarray()
    equal = np.zeros(m, dtype=bool)
    equal[eliminations[0].constraints.ravel()] = True
    row = m - 1
    for one, two in ((0, 2), (2, 4), (0, 6)):  # of the first and the second system, and so on
        if tie == "hessian":
            curved[one, two] = curved[two, one] = 1.0
        elif tie == "own row":
            dense[one, two] = 1.0
        else:
            dense[row, [one, two]] = rng.normal(size=2)
            equal[row] = tie == "equality"
            row -= 1
    J, H = sp.csc_array(dense), sp.csc_array(curved)
    c = Condenser(J, H, eliminations, equal, np.zeros(n, dtype=bool), algebra)
    newton = NewtonSystem(c, np.zeros(0, dtype=int), algebra)
    weights = 0.1 + rng.random(c.remaining.size)
    assert newton.factor(J, H, np.zeros(c.free.size), lambda _: weights.copy(), hard=True)
    gradient, residual = rng.normal(size=n), rng.normal(size=m)
    step, y = newton.solve(gradient, residual)
    softness = np.zeros(m)
    softness[c.remaining] = 1.0 / weights
    softness[equal] = 0.0
    system = np.block([[curved + newton.shift * np.eye(n), dense.T], [dense, -np.diag(softness)]])
    exact = np.linalg.solve(system, -np.concatenate([gradient, residual]))
    np.testing.assert_allclose(step, exact[:n], atol=1e-8 * (1 + np.abs(exact).max()))
    np.testing.assert_allclose(y, exact[n:], atol=1e-8 * (1 + np.abs(exact).max()))


def test_variables_without_rows_of_their_own_stay_free():
    J = sp.csc_array(np.array([[1.0, 1, 0], [0, 0, 1]]))
    equal = np.array([True, False])
    wanted = [
        Determined((0,), np.array([0, 1])),
        Determined((0,), np.array([2])),
        Determined((1,), np.array([1])),
    ]
    (found,) = find_eliminations(J, equal, wanted)
    assert (found.constraints.tolist(), found.variables.tolist()) == ([[0]], [[1]])


@given(seed=st.integers(0, 10**6), n=st.integers(1, 150), wide=st.integers(0, 2))
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_the_factor_in_blocks_against_dense_algebra(algebra, seed, n, wide):
    rng = np.random.default_rng(seed)
    K = np.zeros((n, n))
    for k in range(0, n, 3):  # neighbours touch each other, and a few touch all
        at = np.unique(np.concatenate([np.arange(k, min(n, k + 6)), np.arange(min(wide, n))]))
        rows = rng.normal(size=(at.size + 1, at.size))
        K[np.ix_(at, at)] += rows.T @ rows
    K += np.eye(n)
    pattern = K != 0.0
    i, j = np.nonzero(np.tril(pattern))
    matrix = BlockCholesky(pattern, algebra)

    def values(dense):
        out = np.zeros(matrix.size)
        out[matrix.places(i, j)] = dense[i, j]
        return out

    assert matrix.factor(values(K))
    right = rng.normal(size=(n, 3))
    np.testing.assert_allclose(K @ matrix.solve(right), right, atol=1e-9 * np.linalg.cond(K))
    np.testing.assert_allclose(K @ matrix.solve(right[:, 0]), right[:, 0], atol=1e-9 * np.linalg.cond(K))
    assert not matrix.factor(values(K - 1.01 * np.linalg.eigvalsh(K)[-1] * np.eye(n)))


def test_more_columns_than_variables_are_solved_for(algebra):
    """As with many equalities that depend on each other."""
    K = 3 * np.eye(40) + np.eye(40, k=1) + np.eye(40, k=-1)
    i, j = np.nonzero(np.tril(K))
    matrix = BlockCholesky(K != 0.0, algebra)
    values = np.zeros(matrix.size)
    values[matrix.places(i, j)] = K[i, j]
    assert matrix.factor(values)
    right = np.random.default_rng(0).normal(size=(40, 50_000))
    np.testing.assert_allclose(K @ matrix.solve(right), right, atol=1e-12)


def test_a_motions_own_rows_are_found_and_its_step_is_the_whole_one(algebra, biped_transcription):
    t = biped_transcription
    p = t.program
    rng = np.random.default_rng(0)
    x = first_iterate(t) + 1e-3 * rng.normal(size=p.n)
    y = rng.normal(size=p.m)
    J, H = p.jacobian(x), p.hessian(x, 1.0, y)
    equal = p.g_lower == p.g_upper
    wanted = [Determined(*w) for w in p.determined if len(w[1])]
    c = Condenser(J, H, find_eliminations(J, equal, wanted), equal, np.zeros(p.n, dtype=bool), algebra)
    assert c.eliminated.size == sum(w.variables.size for w in wanted)
    assert c.equal.size < 60  # of the hundreds there are
    newton = NewtonSystem(c, np.zeros(0, dtype=int), algebra)
    weights = 10.0 ** rng.uniform(-6, 6, size=c.remaining.size)
    assert newton.factor(J, H, np.zeros(c.free.size), lambda _: weights.copy(), hard=True)
    gradient, residual = p.gradient(x), 1e-3 * rng.normal(size=p.m)
    d, multipliers = newton.solve(gradient, residual)
    size = np.abs(multipliers).max()
    dual = gradient + H @ d + newton.shift * d + J.T @ multipliers
    np.testing.assert_allclose(dual, 0, atol=1e-9 * size)
    off = (J @ d + residual)[equal]
    np.testing.assert_allclose(off, 0, atol=1e-8 * np.abs(d).max())
    soft = np.setdiff1d(c.remaining, np.flatnonzero(equal))
    expected = weights[~np.isin(c.remaining, np.flatnonzero(equal))] * (J @ d + residual)[soft]
    np.testing.assert_allclose(multipliers[soft], expected, atol=1e-9 * size)
