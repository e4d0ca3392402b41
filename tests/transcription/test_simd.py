"""Vectorized functions against CasADi's own functions of one instance."""

from __future__ import annotations

import gc
import hashlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray
from support.small_plans import arm_problem, transcribed

from impactopt import NoCompilerWarning
from impactopt.codegen.batched import BatchedFunction
from impactopt.codegen.cache import cached
from impactopt.codegen.compiler import NativeCode, find_compiler
from impactopt.transcription import simd
from impactopt.transcription.initial_guess import first_iterate
from impactopt.transcription.simd import LANES, in_lanes
from impactopt.transcription.structured import derivative_functions
from impactopt.transcription.transcription import Transcription

Array = NDArray[np.float64]
JOINED = {simd.SUM_OF_PRODUCT, simd.PRODUCT_LESS, simd.LESS_PRODUCT}
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path / "cache"))
    gc.freeze()  # as in test_codegen.py
    yield tmp_path / "cache"
    gc.collect()


def compiled(*functions: Any, count: int = LANES) -> dict[str, Any]:
    return cached("lanes", (count,), lambda: in_lanes(functions, count))


def every_operation() -> Any:
    """A function of z (4) and p (1) with all operations that lanes know; the last input row is an angle."""
    z, p = ca.SX.sym("z", 4), ca.SX.sym("p", 1)
    a, b, c, d = ca.vertsplit(z)
    small = a / (1 + ca.fabs(a))  # in (-1, 1)
    big = 1 + a**2
    out = [
        a + b - p[0] * c / big + (-d) + 2 * a + 1 / big + 0.1 * d**2,
        ca.sqrt(big) + ca.sin(b) * ca.cos(c) - ca.tan(small),
        ca.asin(small) + ca.acos(small) + ca.atan(b) + ca.atan2(c, d),
        ca.sinh(small) + ca.cosh(small) + ca.tanh(b) + ca.exp(-big) + ca.log(big),
        big**b + ca.fmin(a, b) + ca.fmax(c, d) + ca.sign(a) + ca.hypot(a, b) + big**2.5,
        ca.if_else(a < b, c, d) + ca.if_else(a <= 0, b, c) + ca.if_else(p[0] == a, 3.0, 4.0),
        ca.if_else(ca.logic_and(a > 0, b > 0), c, 0) + ca.if_else(ca.logic_or(a > 0, c > 0), d, 0),
        ca.if_else(ca.logic_not(a > b), 5.0, 0) + (c != d),
        ca.SX(0.0),
    ]
    return z, p, ca.vertcat(*out)


@needs_compiler
@pytest.mark.parametrize(("window", "count"), [(1, 8), (3, 4), (10_000, 2)])
def test_every_operation_gives_in_lanes_what_it_gives_alone(
    cache: Path, monkeypatch: pytest.MonkeyPatch, window: int, count: int
) -> None:
    monkeypatch.setattr(simd, "WINDOW", window)
    functions = derivative_functions("all", *every_operation())
    found, rng = compiled(*functions, count=count), np.random.default_rng(0)
    for plain in functions:
        function = found[plain.name()]
        mapped = plain.map(count)
        assert isinstance(in_lanes([plain])[0], NativeCode)
        assert (function.name_in(), function.name_out()) == (plain.name_in(), plain.name_out())
        for i in range(plain.n_in()):
            assert function.sparsity_in(i) == mapped.sparsity_in(i)
        assert function.sparsity_out(0) == mapped.sparsity_out(0)
        for _ in range(5):
            arguments = [rng.standard_normal((plain.size1_in(i), count)) for i in range(plain.n_in())]
            half = slice(count // 2)
            arguments[1][0, half] = arguments[0][0, half]  # p equals a in half of the lanes
            arguments[0][2, ::2] = arguments[0][3, ::2]
            expected = np.array(mapped(*arguments).nonzeros())
            assert np.isfinite(expected).all()
            np.testing.assert_allclose(function(*arguments).nonzeros(), expected, rtol=1e-14, atol=1e-14)


@needs_compiler
def test_a_product_and_the_sum_with_it_are_one_operation_and_equal_ones_are_done_once(cache: Path) -> None:
    a, b, c, d = x = [ca.SX.sym(name) for name in "abcd"]
    kept = c * d  # needed as it is, too
    out = [a * b + c, c - d * a, b * c - a, d * c + a, kept, b * a + c]
    function = ca.Function("f", [ca.vertcat(*x)], [ca.vertcat(*out)])
    expected = [
        *[
            (simd.SUM_OF_PRODUCT, 1),
            (simd.LESS_PRODUCT, 1),
            (simd.PRODUCT_LESS, 1),
        ],
        *[(ca.OP_MUL, 1), (ca.OP_ADD, 1), (ca.OP_ASSIGN, 1)],
    ]
    assert sorted(runs(function)) == sorted(expected)
    given = np.arange(4.0 * LANES).reshape(4, LANES)
    (fast,) = compiled(function).values()
    np.testing.assert_array_equal(fast(given), function.map(LANES)(given))


def runs(function: Any) -> list[tuple[int, int]]:
    """Kind and number of operations of each run."""
    made = simd.instruction_table(function, simd._OPERANDS)
    assert made is not None
    out, words = [], made.words.tolist()
    while words:
        kind, count = words[:2]
        out.append((kind, count))
        words = words[2 + count * (simd._OPERANDS[kind] + 1) :]
    return out


@needs_compiler
def test_operations_of_a_kind_come_together_as_far_as_the_window_reaches(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    x = ca.SX.sym("x", 30)
    out = [f(x[k]) for k in range(30) for f in (ca.sin, ca.exp)]
    function = ca.Function("f", [x], [ca.vertcat(*out)])
    assert len(runs(function)) == 2
    monkeypatch.setattr(simd, "WINDOW", 10)
    few = runs(function)
    assert 4 <= len(few) <= 20
    monkeypatch.setattr(simd, "WINDOW", 1)
    assert len(runs(function)) == 60


@needs_compiler
def test_functions_of_a_block_are_one_library(cache: Path) -> None:
    compiled(*derivative_functions("all", *every_operation()))
    (library,) = [path for path in cache.glob("*.so") if "arrange" not in path.name]
    assert library.name.startswith("all-")


def of_loops(cache: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in cache.glob("*.o")}


@needs_compiler
def test_functions_of_other_blocks_have_the_same_loops(cache: Path) -> None:
    x, given = ca.SX.sym("x", 2), np.arange(2.0 * LANES).reshape(2, LANES)
    first, second = ca.Function("f", [x], [3 * x]), ca.Function("g", [x], [ca.sin(x) + x[0]])
    found = {**compiled(first), **cached("others", (), lambda: in_lanes([second]))}
    assert len(of_loops(cache)) == 1 and {path.name[:2] for path in cache.glob("[fg]-*.so")} == {"f-", "g-"}
    for function in (first, second):
        np.testing.assert_array_equal(found[function.name()](given), function.map(LANES)(given))


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("mode", [0o700, 0o722])
def test_loops_that_others_could_have_written_are_not_linked(cache: Path, mode: int) -> None:
    x, given = ca.SX.sym("x", 2), np.arange(2.0 * LANES).reshape(2, LANES)
    compiled(ca.Function("f", [x], [3 * x]))
    ((loops, content),) = of_loops(cache).items()
    loops.write_bytes(b"of someone else")
    if mode != 0o700:
        loops.with_suffix(".sha256").write_text(hashlib.sha256(loops.read_bytes()).hexdigest())
    loops.chmod(mode)
    second = ca.Function("g", [x], [x - 1])
    found = cached("others", (), lambda: in_lanes([second]))["g"]
    np.testing.assert_array_equal(found(given), second.map(LANES)(given))
    assert of_loops(cache) == {loops: content} and loops.stat().st_mode & 0o022 == 0


@pytest.mark.slow
@needs_compiler
def test_more_places_than_a_short_number_can_name(cache: Path) -> None:
    x, n = ca.SX.sym("x", 70_000), 70_000
    function = ca.Function("f", [x], [ca.vertcat(2.5 * x, x[0], 3.0, 2.5 * x[1])])
    (fast,) = compiled(function, count=2).values()
    given = np.arange(2.0 * n).reshape(2, n).T
    out = np.array(fast(given))
    np.testing.assert_array_equal(out[:n], 2.5 * given)
    np.testing.assert_array_equal(out[n:], [given[0], [3.0, 3.0], 2.5 * given[1]])


@needs_compiler
def test_each_lane_is_on_its_own(cache: Path) -> None:
    x = ca.SX.sym("x", 2)
    (function,) = compiled(ca.Function("f", [x], [ca.vertcat(1 / x[0], ca.sqrt(x[1]))])).values()
    arguments = np.ones((2, LANES))
    arguments[:, 3] = 0.0, -1.0
    out = np.array(function(arguments))
    assert np.isinf(out[0, 3]) and np.isnan(out[1, 3])
    np.testing.assert_array_equal(np.delete(out, 3, axis=1), 1)


@needs_compiler
def test_any_count_of_instances_fills_whole_calls(cache: Path) -> None:
    functions = derivative_functions("all", *every_operation())
    found = compiled(*functions)
    for count in (1, 7, LANES, LANES + 3, 2 * LANES):
        rng = np.random.default_rng(count)
        z, p, multipliers = (rng.standard_normal((count, n)) for n in (4, 1, 9))
        for plain in functions:
            one, many = BatchedFunction(plain, count, p), BatchedFunction(found[plain.name()], count, p)
            given = (z, multipliers) if plain.n_in() == 3 else (z,)
            for a in (given, tuple(-x for x in given)):
                np.testing.assert_allclose(many(*a), one(*a), rtol=1e-14, atol=1e-14)
            assert many(*given).shape == (count, plain.nnz_out(0))
            filled = many.inputs[0]
            assert len(filled) % LANES == 0 and len(filled) - count < LANES
            np.testing.assert_array_equal(filled[count:], np.broadcast_to(z[-1], filled[count:].shape))
            for a, b in zip(many.pattern, one.pattern, strict=True):
                np.testing.assert_array_equal(a, b)


def test_the_operations_above_are_all() -> None:
    functions = derivative_functions("all", *every_operation())
    kinds = {f.instruction_id(k) for f in functions for k in range(f.n_instructions())}
    assert kinds >= {*simd._OF_VECTORS, *simd._IN_EACH_LANE} - {ca.OP_ASSIGN, *JOINED}


def test_an_unknown_operation_stays_out_of_lanes() -> None:
    x = ca.SX.sym("x", 2)
    function, known = ca.Function("f", [x], [ca.erf(x)]), ca.Function("g", [x], [2 * x])
    assert in_lanes([function]) == [function]
    assert in_lanes([function, known])[0] is function


def test_without_a_compiler_an_instance_a_call(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IMPACTOPT_NO_COMPILER", "1")
    value, *_ = derivative_functions("all", *every_operation())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoCompilerWarning)
        assert compiled(value)["all"] is value


@pytest.mark.slow
@needs_compiler
def test_a_program_in_lanes_is_the_program(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks of a small robot's motion."""
    problem = arm_problem()
    with monkeypatch.context() as without:
        without.setenv("IMPACTOPT_NO_COMPILER", "1")
        plain = transcribed(problem)
    fast = Transcription(problem, compiled(*plain.functions.values()))
    rng = np.random.default_rng(1)
    x = first_iterate(plain) + 0.01 * rng.standard_normal(plain.program.n)
    multipliers = rng.standard_normal(plain.program.m)
    for name, out in fast.program.outputs(x).items():
        np.testing.assert_allclose(out, plain.program.outputs(x)[name], rtol=1e-14, atol=1e-14)
    a, b = (t.program for t in (plain, fast))
    assert all(block.value.columns == LANES for block in b.blocks)
    same(a.constraints(x), b.constraints(x))
    same(a.jacobian(x).data, b.jacobian(x).data)
    same(a.hessian(x, 1.3, multipliers).data, b.hessian(x, 1.3, multipliers).data)


def same(a: Array, b: Array) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14 * np.abs(a).max())
