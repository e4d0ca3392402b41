"""Layout, affine lifts and the structured program: its derivatives against one monolithic CasADi program."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from impactopt import InputError, Status
from impactopt.codegen.batched import pattern
from impactopt.kinematics.stages import Stage
from impactopt.solvers.ipopt import solve_ipopt
from impactopt.solvers.program import NonlinearProgram
from impactopt.transcription.builder import Block
from impactopt.transcription.layout import Affine, Constraints, Layout, select, stack
from impactopt.transcription.structured import StructuredProgram, derivative_functions

Array = NDArray[np.float64]
seeds = st.integers(0, 2**31)


# ---- a random program, twice: in blocks, and as one expression


class Pair:
    """A random structured program and the same written down as one CasADi expression."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.layout = Layout()
        groups = [
            self.layout.add(name, count, size, scale=rng.uniform(0.3, 3.0, size))
            for name, count, size in (("a", 3, 2), ("b", 1, 3), ("c", 2, 1), ("empty", 2, 0))
        ]
        n = self.layout.n
        self.x = ca.SX.sym("x", n)

        def slot(size: int) -> Affine:
            """A random affine expression; some variables come several times, some entries are constant."""
            out = Affine.constant(rng.standard_normal(size))
            for g in groups[:3]:
                if rng.uniform() < 0.7:
                    out = out + g[int(rng.integers(g.count))].apply(rng.standard_normal((size, g.size)))
            return out[np.arange(size)] if rng.uniform() < 0.5 else out

        def block(name: str, sizes: tuple[int, ...], outputs: int, n_p: int, count: int) -> tuple[Block, Any]:
            z, p = ca.SX.sym("z", sum(sizes)), ca.SX.sym("p", n_p)
            out = []
            for _ in range(outputs):
                i, j, k = rng.integers(z.numel(), size=3)
                scale = p[int(rng.integers(n_p))] if n_p else 1.0
                out.append(scale * ca.sin(z[int(i)]) * z[int(j)] + z[int(k)] ** 3 / 3)
            expression = ca.vertcat(*out)
            functions = {f.name(): f for f in derivative_functions(name, z, p, expression)}
            instances = [[slot(s) for s in sizes] for _ in range(count)]
            parameters = rng.standard_normal((count, n_p))
            rows = [
                functions[name](self.expression(stack(slots)), parameters[i])
                for i, slots in enumerate(instances)
            ]
            return Block.make(name, functions, instances, parameters), ca.vertcat(*rows)

        one, one_out = block("one", (2, 3), 3, 2, 3)
        two, two_out = block("two", (1, 2), 2, 0, 1)
        self.blocks, outputs = [one, two], ca.vertcat(one_out, two_out)
        rows, wanted = Constraints(), []
        # not all outputs are in constraints, their order is mixed; a constraint may be affine, or both
        chosen = rng.permutation(outputs.numel())[:-3]
        for k, some in enumerate(np.array_split(chosen, 3)):
            affine = slot(len(some)) if k != 1 else None
            rows.add(
                term=f"term {k}",
                place="here",
                components=[f"part {i}" for i in range(len(some))],
                outputs=some.astype(np.intp),
                affine=affine,
                lower=-1.0 - k,
                upper=2.0 + k,
            )
            value = ca.vertcat(*[outputs[int(i)] for i in some])
            wanted.append(value if affine is None else value + self.expression(affine))
        linear = slot(2)
        rows.add(term="linear", components=["u", "v"], affine=linear, lower=0.0, upper=0.0)
        wanted.append(self.expression(linear))
        self.g = ca.vertcat(*wanted)
        goal, q = slot(2), rng.standard_normal((n, n))
        quadratic, slope = q @ q.T, rng.standard_normal(n)
        self.rows, self.goal, self.slope = rows, goal, slope
        self.program = StructuredProgram(
            self.layout, self.blocks, rows, objective=goal, quadratic=sp.csr_array(quadratic), linear=slope
        )
        self.f = (
            ca.sum1(self.expression(goal)) + 0.5 * ca.bilin(quadratic, self.x, self.x) + ca.dot(slope, self.x)
        )
        sigma, y = ca.SX.sym("sigma"), ca.SX.sym("y", self.g.numel())
        hessian = ca.hessian(sigma * self.f + ca.dot(y, self.g), self.x)[0]
        self.values = ca.Function("values", [self.x], [self.f, ca.gradient(self.f, self.x), self.g])
        self.jacobian = ca.Function("jacobian", [self.x], [ca.jacobian(self.g, self.x)])
        self.hessian = ca.Function("hessian", [self.x, sigma, y], [hessian])

    def expression(self, affine: Affine) -> Any:
        return ca.DM(affine.matrix(self.layout.n).toarray()) @ self.x + affine.const


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_a_structured_program_is_the_monolithic_one(seed: int) -> None:
    pair, rng = Pair(seed), np.random.default_rng(seed + 1)
    program = pair.program
    assert isinstance(program, NonlinearProgram)
    for _ in range(2):
        x, y, sigma = rng.standard_normal(program.n), rng.standard_normal(program.m), rng.uniform(0.5, 2)
        f, gradient, g = (np.array(v).ravel() for v in pair.values(x))
        assert program.objective(x) == pytest.approx(float(f[0]), rel=1e-12, abs=1e-12)
        np.testing.assert_allclose(program.gradient(x), gradient, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(program.constraints(x), g, rtol=1e-11, atol=1e-12)
        jacobian, hessian = program.jacobian(x), program.hessian(x, sigma, y)
        np.testing.assert_allclose(jacobian.toarray(), np.array(pair.jacobian(x)), rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(
            hessian.toarray(), np.array(pair.hessian(x, sigma, y)), rtol=1e-9, atol=1e-10
        )
        np.testing.assert_allclose(hessian.toarray(), hessian.toarray().T, atol=1e-12)


@pytest.mark.parametrize("coupled", [True, False], ids=["within its pattern", "beyond its pattern"])
@given(seeds)
@settings(max_examples=5, deadline=None)
def test_the_hessian_of_a_program_grows_from_that_of_its_first_blocks(coupled: bool, seed: int) -> None:
    pair, rng = Pair(seed), np.random.default_rng(seed + 2)
    full = pair.program.quadratic.toarray()
    own = full if coupled else np.diag(np.diag(full))
    kind = {"quadratic": sp.csr_array(own), "linear": pair.slope}
    base = StructuredProgram(pair.layout, pair.blocks[:1], Constraints(), objective=pair.goal, **kind)
    program = StructuredProgram(pair.layout, pair.blocks, pair.rows, objective=pair.goal, base=base, **kind)
    x, y, sigma = rng.standard_normal(program.n), rng.standard_normal(program.m), 1.5
    wanted = np.array(pair.hessian(x, sigma, y)) + sigma * (own - full)
    found = program.hessian(x, sigma, y)
    np.testing.assert_allclose(found.toarray(), wanted, rtol=1e-9, atol=1e-10)
    assert found.has_canonical_format


def test_derivatives_agree_with_differences() -> None:
    pair, rng = Pair(3), np.random.default_rng(4)
    program = pair.program
    x, y, h = rng.standard_normal(program.n), rng.standard_normal(program.m), 1e-6

    def slope(x: Array) -> Array:
        return np.asarray(2.0 * program.gradient(x) + program.jacobian(x).T @ y)

    steps = h * np.eye(program.n)
    jacobian = np.stack(
        [(program.constraints(x + e) - program.constraints(x - e)) / (2 * h) for e in steps], 1
    )
    hessian = np.stack([(slope(x + e) - slope(x - e)) / (2 * h) for e in steps], 1)
    np.testing.assert_allclose(program.jacobian(x).toarray(), jacobian, atol=1e-7 * np.abs(jacobian).max())
    np.testing.assert_allclose(
        program.hessian(x, 2.0, y).toarray(), hessian, atol=1e-7 * np.abs(hessian).max()
    )


def test_patterns_do_not_depend_on_the_point() -> None:
    program = Pair(5).program
    rng = np.random.default_rng(0)
    points = [np.zeros(program.n), rng.standard_normal(program.n)]
    for make in (program.jacobian, lambda x: program.hessian(x, x.sum(), np.full(program.m, x.sum()))):
        first, second = (make(x) for x in points)
        np.testing.assert_array_equal(first.indptr, second.indptr)
        np.testing.assert_array_equal(first.indices, second.indices)
        assert first.has_canonical_format


def test_results_are_not_overwritten_by_the_next_call() -> None:
    """The blocks' buffers are reused; what the program returns must not be."""
    program = Pair(6).program
    x = np.linspace(-1, 1, program.n)
    y = np.ones(program.m)
    first = (program.constraints(x), program.jacobian(x), program.hessian(x, 1.0, y), program.outputs(x))
    kept = (first[0].copy(), first[1].copy(), first[2].copy(), {k: v.copy() for k, v in first[3].items()})
    program.constraints(-x), program.jacobian(-x), program.hessian(-x, 1.0, -y), program.outputs(-x)
    np.testing.assert_array_equal(first[0], kept[0])
    for a, b in zip(first[1:3], kept[1:3], strict=True):
        np.testing.assert_array_equal(a.toarray(), b.toarray())
    for name, value in kept[3].items():
        np.testing.assert_array_equal(first[3][name], value)


def test_outputs_are_by_block_and_instance() -> None:
    pair = Pair(7)
    x = np.linspace(-1, 1, pair.program.n)
    out = pair.program.outputs(x)
    assert {k: v.shape for k, v in out.items()} == {"one": (3, 3), "two": (1, 2)}


def test_a_program_of_affine_constraints_alone() -> None:
    layout = Layout()
    x = layout.add("x", 1, 2)
    rows = Constraints()
    rows.add(term="sum", components=["s"], affine=x[0].apply([[1.0, 1.0]]), lower=2.0, upper=2.0)
    program = StructuredProgram(
        layout, [], rows, objective=Affine.constant(5.0), quadratic=sp.eye_array(2), linear=np.zeros(2)
    )
    result = solve_ipopt(program, np.zeros(2))
    assert result.status is Status.SOLVED
    np.testing.assert_allclose(result.x, [1, 1], atol=1e-6)
    assert result.objective == pytest.approx(6.0, abs=1e-6)


# ---- constraints and names


def test_constraints_without_bounds_are_dropped_and_the_others_keep_their_names() -> None:
    layout = Layout()
    x = layout.add("x", 1, 3)
    rows = Constraints()
    rows.add(
        term="torque limit",
        place="swing, node 7",
        components=["hip", "knee", "ankle"],
        affine=x[0],
        lower=[-1.0, -np.inf, -np.inf],
        upper=[np.inf, np.inf, 2.0],
    )
    rows.add(term="free", components=["all", "of it"], affine=x[0][:2])
    rows.add(term="no place", components=[""], affine=x[0][1:2], upper=0.0)
    program = StructuredProgram(
        layout, [], rows, objective=Affine.constant(0.0), quadratic=sp.csr_array((3, 3)), linear=np.zeros(3)
    )
    assert [program.constraint_name(i) for i in range(program.m)] == [
        "torque limit, swing, node 7, hip",
        "torque limit, swing, node 7, ankle",
        "no place",
    ]
    np.testing.assert_array_equal(program.constraints(np.array([1.0, 2.0, 3.0])), [1, 3, 2])
    np.testing.assert_array_equal(program.g_lower, [-1, -np.inf, -np.inf])
    np.testing.assert_array_equal(program.g_upper, [np.inf, 2, 0])


def test_dropped_constraints_of_a_block_leave_the_others_in_place() -> None:
    layout = Layout()
    group = layout.add("x", 1, 3)
    z, p = ca.SX.sym("z", 3), ca.SX.sym("p", 0)
    functions = {f.name(): f for f in derivative_functions("square", z, p, z**2)}
    block = Block.make("square", functions, [[group[0]]], np.zeros(0))
    rows = Constraints()
    bounds = np.array([1.0, np.inf, 3.0])
    rows.add(
        term="square", components=list("abc"), outputs=np.array([2, 1, 0]), affine=group[0], upper=bounds
    )
    program = StructuredProgram(
        layout,
        [block],
        rows,
        objective=Affine.constant(0.0),
        quadratic=sp.csr_array((3, 3)),
        linear=np.zeros(3),
    )
    x = np.array([2.0, 3.0, 5.0])
    np.testing.assert_array_equal(program.constraints(x), [25 + 2, 4 + 5])
    np.testing.assert_array_equal(program.jacobian(x).toarray(), [[1, 0, 10], [4, 0, 1]])
    assert program.constraint_name(1) == "square, c"


def test_a_block_takes_as_many_inputs_as_it_has() -> None:
    z = ca.SX.sym("z", 3)
    functions = {f.name(): f for f in derivative_functions("f", z, ca.SX.sym("p", 0), z**2)}
    with pytest.raises(ValueError, match="f takes 3 inputs, was given 2"):
        Block.make("f", functions, [[Affine.zeros(2)]], np.zeros(0))


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_derivative_functions_are_the_jacobian_and_the_lower_hessian(seed: int) -> None:
    rng = np.random.default_rng(seed)
    z, p = ca.SX.sym("z", 4), ca.SX.sym("p", 2)
    out = ca.vertcat(p[0] * z[0] * z[1], ca.sin(z[2]) + p[1], 0.0)
    value, jac, hess = derivative_functions("f", z, p, out)
    at, par, lam, h = rng.standard_normal(4), rng.standard_normal(2), rng.standard_normal(3), 1e-5
    assert [f.name() for f in (value, jac, hess)] == ["f", "f_jac", "f_hess"]
    assert value.nnz_out(0) == 3  # dense, so that outputs can be counted
    by_hand = [[par[0] * at[1], par[0] * at[0], 0, 0], [0, 0, np.cos(at[2]), 0], [0, 0, 0, 0]]
    np.testing.assert_allclose(np.array(jac(at, par)), by_hand, atol=1e-14)
    steps = h * np.eye(4)
    grad = [
        (np.array(jac(at + e, par)) - np.array(jac(at - e, par))).T @ lam / (2 * h) for e in steps
    ]  # rows of the Hessian
    lower = np.array(hess(at, par, lam))
    np.testing.assert_allclose(lower, np.tril(lower), atol=0)
    np.testing.assert_allclose(lower + np.tril(lower, -1).T, np.array(grad), atol=1e-8)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_derivatives_in_stages_are_those_of_the_whole(seed: int) -> None:
    rng = np.random.default_rng(seed)
    z, p, s = ca.SX.sym("z", 5), ca.SX.sym("p", 2), ca.SX.sym("s", 2)
    of_z = ca.vertcat(z[0] + z[1] * z[2] * p[0], ca.sin(z[3]) / z[1])
    out = ca.vertcat(s[0] ** 2 * s[1] + z[4] * s[0], ca.exp(s[1]) * z[0] + p[1], z[2] * z[4], 0.0)
    split = derivative_functions("f", z, p, out, [Stage(s, of_z)])
    whole = derivative_functions("f", z, p, ca.substitute(out, s, of_z))
    numbers = 0.5 + rng.random(5), rng.standard_normal(2), rng.standard_normal(4)
    for one, other in zip(split, whole, strict=True):
        inputs = numbers[: one.n_in()]
        np.testing.assert_allclose(one(*inputs).full(), other(*inputs).full(), rtol=1e-12, atol=1e-12)


def test_pattern_is_in_casadis_order() -> None:
    matrix = ca.DM([[1, 0, 2], [0, 0, 3], [4, 0, 5]])
    rows, columns = pattern(ca.sparsify(matrix).sparsity())
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == [(0, 0), (2, 0), (0, 2), (1, 2), (2, 2)]


# ---- affine expressions and the layout


@given(seeds)
def test_affine_algebra(seed: int) -> None:
    rng = np.random.default_rng(seed)
    layout = Layout()
    group = layout.add("x", 3, 2, scale=[0.5, 2.0])
    x = rng.standard_normal(layout.n)
    a = group[0] + 3.0 * group[2] + Affine.constant(rng.standard_normal(2))
    b = group[1] - group[0] * np.array([1.0, -2.0])
    va, vb = a.evaluate(x), b.evaluate(x)
    np.testing.assert_allclose(a.matrix(layout.n) @ x + a.const, va, atol=1e-12)
    np.testing.assert_allclose((a + b).evaluate(x), va + vb, atol=1e-12)
    np.testing.assert_allclose((a - b * 0.5).evaluate(x), va - vb / 2, atol=1e-12)
    np.testing.assert_allclose((-a).evaluate(x), -va, atol=1e-12)
    m = rng.standard_normal((4, 2))
    np.testing.assert_allclose(a.apply(m).evaluate(x), m @ va, atol=1e-12)
    np.testing.assert_allclose(a[1:2].evaluate(x), va[1:], atol=1e-12)
    np.testing.assert_allclose(a[np.array([1, 0, 1])].evaluate(x), va[[1, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(select(a, np.array([], dtype=np.intp)).evaluate(x), [])
    np.testing.assert_allclose(stack([a, Affine.zeros(1), b]).evaluate(x), [*va, 0, *vb], atol=1e-12)
    np.testing.assert_allclose(sum([a, b, 2.0]).evaluate(x), va + vb + 2.0, atol=1e-12)
    np.testing.assert_allclose((m[0, :2] + a - 1.0).evaluate(x), m[0, :2] + va - 1.0, atol=1e-12)
    np.testing.assert_allclose((1.0 - a / 2.0).evaluate(x), 1.0 - va / 2.0, atol=1e-12)
    with pytest.raises(InputError, match="not affine: `lift`"):
        a * b
    with pytest.raises(InputError, match="not affine: `lift`"):
        a / b
    with pytest.raises(ValueError, match="sizes 2 and 3"):
        a + Affine.zeros(3)


def test_groups_are_in_physical_units_and_bounds_in_the_solvers() -> None:
    layout = Layout()
    one = layout.add(
        "one", 2, 3, lower=-1.0, upper=[1.0, 2.0, 4.0], scale=[1.0, 10.0, 0.5], labels=list("abc")
    )
    two = layout.add("two", 1, 2)
    x = np.zeros(layout.n)
    values = np.arange(6.0).reshape(2, 3)
    one.write(x, values)
    two.write(x, 7.0)
    np.testing.assert_array_equal(one.read(x), values)
    np.testing.assert_array_equal(one[1].evaluate(x), values[1])
    np.testing.assert_array_equal(one[-1].evaluate(x), values[1])
    np.testing.assert_array_equal(two.read(x), [[7.0, 7.0]])
    assert layout.n == 8
    np.testing.assert_allclose(layout.upper[:3], [1.0, 0.2, 8.0])
    np.testing.assert_allclose(layout.lower[3:6], [-1.0, -0.1, -2.0])
    assert np.isinf(layout.upper[6:]).all()
    assert layout.name(4) == "one[1], b"
    assert layout.name(7) == "two[0], 1"
    with pytest.raises(IndexError, match="one has 2 members"):
        one[2]
    with pytest.raises(IndexError):
        layout.name(8)
