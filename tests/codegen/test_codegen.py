"""Compiled functions: equal to the VM's, built once, and never loaded where others could have written."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from support.one_joint import model

from impactopt import CacheWarning, InputError, NoCompilerWarning
from impactopt.codegen import cache as codegen
from impactopt.codegen import compiler as library
from impactopt.codegen import files as directory
from impactopt.codegen import files as private_files
from impactopt.codegen.cache import FunctionGroup, cached, cached_groups, canonical, model_hash
from impactopt.codegen.compiler import Compiler, find_compiler
from impactopt.codegen.files import cache_directory

ROOT = Path(__file__).parents[2]
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


class Builder:
    """Builds y = scale * sin(x) + x0 x and its sparse Jacobian, and counts how often."""

    def __init__(self, scale: float = 2.0) -> None:
        self.scale = scale
        self.calls = 0

    def __call__(self) -> list[ca.Function]:
        self.calls += 1
        x = ca.SX.sym("x", 3)
        y = self.scale * ca.sin(x) + x[0] * x
        return [
            ca.Function("value", [x], [y], ["x"], ["y"]),
            ca.Function("slope", [x], [ca.jacobian(y, x)], ["x"], ["slope"]),
        ]


X = np.array([0.3, -1.2, 2.5])


def value(functions: dict[str, ca.Function]) -> float:
    return float(functions["value"](X)[1])


TRUE = 2.0 * np.sin(X[1]) + X[0] * X[1]


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    path = tmp_path / "cache"
    monkeypatch.setenv("IMPACTOPT_CACHE", str(path))
    private_files.temporary_private_directory.cache_clear()
    private_files._warn_temporary.cache_clear()
    gc.freeze()  # the tests' own objects are collected, not all that other tests have left
    yield path
    gc.collect()  # unload the libraries: a later test may put others at the same paths


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two caches, `good` with a toy's functions and `bad` with those of another; compiled once for all tests
    that then do something to a copy.
    """
    caches = tmp_path_factory.mktemp("compiled")
    for name, scale in (("good", 2.0), ("bad", 666.0)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("IMPACTOPT_CACHE", str(caches / name))
            cached("toy", (1,), Builder(scale))
    gc.collect()
    return caches


@pytest.fixture
def filled(cache: Path, compiled: Path) -> Path:
    """A cache that has the toy's functions."""
    return Path(shutil.copytree(compiled / "good", cache))


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Optimization levels of the compilations that take place."""
    levels: list[str] = []
    run = Compiler.run

    def spy(self: Compiler, source: Path, library: Path, level: str) -> None:
        levels.append(level)
        run(self, source, library, level)

    monkeypatch.setattr(Compiler, "run", spy)
    return levels


def libraries(cache: Path) -> list[Path]:
    return sorted(cache.glob("*.so"))


def entry(cache: Path) -> Path:
    (path,) = cache.glob("*.json")
    return path


# ---- values and keys


@needs_compiler
def test_compiled_functions_equal_the_virtual_machine(cache: Path) -> None:
    compiled = cached("toy", (1,), Builder())
    rng = np.random.default_rng(0)
    for function in Builder()():
        other = compiled[function.name()]
        assert other.class_name() == "External"
        assert (other.name_in(), other.name_out()) == (function.name_in(), function.name_out())
        assert other.sparsity_out(0) == function.sparsity_out(0)
        for x in rng.standard_normal((20, 3)):
            expected = function(x)
            np.testing.assert_allclose(other(x).nonzeros(), expected.nonzeros(), rtol=1e-14, atol=1e-15)
    assert list(compiled) == ["value", "slope"]


@needs_compiler
def test_hit_does_not_build(cache: Path, compilations: list[str]) -> None:
    build = Builder()
    lines: list[str] = []
    first = cached("toy", (1, "a"), build, report=lines.append)
    assert build.calls == 1 and len(compilations) == 2 and len(lines) == 3
    assert "2 of 2" in lines[-1]
    again = cached("toy", (1, "a"), build, report=lines.append)
    assert build.calls == 1 and len(compilations) == 2 and len(lines) == 3
    assert value(first) == value(again) == pytest.approx(TRUE, rel=1e-14)


@needs_compiler
def test_a_compilation_that_nobody_waits_for_is_told_by_the_logger(
    cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As that of a derivative of the collision, which CasADi evaluates for the first time."""
    with caplog.at_level("INFO", "impactopt"):
        cached("toy", (1, "b"), Builder())
    assert caplog.messages[0] == "toy: building the functions" and "2 of 2" in caplog.messages[-1]


@needs_compiler
def test_recipe_name_and_sources_are_in_the_key(
    cache: Path, monkeypatch: pytest.MonkeyPatch, compilations: list[str]
) -> None:
    build = Builder()
    cached("toy", (1,), build)
    other = Builder(scale=5.0)
    assert value(cached("toy", (2,), other)) == pytest.approx(5 * np.sin(X[1]) + X[0] * X[1], rel=1e-14)
    cached("other toy", (1,), build)
    assert (build.calls, other.calls) == (2, 1)
    assert len(compilations) == 4, "the other toy is made of the same C code"
    monkeypatch.setattr(codegen, "_sources_key", lambda: "changed")
    cached("toy", (1,), build)
    assert build.calls == 3 and len(compilations) == 4


@needs_compiler
def test_flags_of_the_compiler_are_in_the_key(
    cache: Path, monkeypatch: pytest.MonkeyPatch, compilations: list[str]
) -> None:
    build = Builder()
    cached("toy", (1,), build)
    compiler = find_compiler()
    assert compiler is not None
    monkeypatch.setenv("CC", f"{compiler.command[0]} -fno-math-errno")
    cached("toy", (1,), build)
    assert build.calls == 2 and len(compilations) == 4


@needs_compiler
@pytest.mark.usefixtures("as_shipped")
def test_long_functions_are_compiled_without_optimization(
    cache: Path, monkeypatch: pytest.MonkeyPatch, compilations: list[str]
) -> None:
    monkeypatch.setattr(library, "MAX_OPTIMIZED", 10)
    x = ca.SX.sym("x", 3)
    inner = ca.Function("inner", [x], [ca.sin(x) * x + ca.cos(x)])
    y = ca.MX.sym("y", 3)
    outer = ca.Function("outer", [y], [inner(y)])
    functions = cached("mixed", (), lambda: [outer, ca.Function("brief", [x], [2 * x])])
    assert sorted(compilations) == ["-O0", "-O1"]  # two at a time
    np.testing.assert_allclose(functions["outer"](X), outer(X), rtol=1e-14)


def test_equal_names_in_a_group(cache: Path) -> None:
    x = ca.SX.sym("x")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoCompilerWarning)
        with pytest.raises(ValueError, match="two functions of one group are named 'f'"):
            cached("twins", (), lambda: [ca.Function("f", [x], [x]), ca.Function("f", [x], [-x])])


def test_canonical_text_of_recipes() -> None:
    long = np.zeros(5000)
    other = long.copy()
    other[2500] = 1
    assert repr(long) == repr(other) and canonical(long) != canonical(other)
    assert canonical((1, "a")) != canonical((1, "b")) and canonical(("ab",)) != canonical(("a", "b"))
    assert canonical((1.0,)) != canonical((1,)) and canonical(None) != canonical("None")
    assert canonical({"a": 1, "b": 2}) == canonical({"b": 2, "a": 1})
    with pytest.raises(TypeError, match="recipe: object is not supported"):
        canonical((object(),))


def test_cache_directory_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path / "own"))
    assert cache_directory() == tmp_path / "own"
    monkeypatch.delenv("IMPACTOPT_CACHE")
    assert cache_directory() == tmp_path / "xdg" / "impactopt"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_directory() == tmp_path / "home" / ".cache" / "impactopt"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert cache_directory() == tmp_path / "home" / ".cache" / "impactopt"
    monkeypatch.delenv("XDG_CACHE_HOME")
    nowhere = Path(tempfile.gettempdir()) / f"impactopt-{os.getuid()}"
    for home in ("/", ""):
        monkeypatch.setenv("HOME", home)
        assert cache_directory() == nowhere

    def none(_uid: int) -> None:
        raise KeyError

    monkeypatch.setattr("pwd.getpwuid", none)
    monkeypatch.delenv("HOME")
    assert cache_directory() == nowhere
    monkeypatch.setenv("IMPACTOPT_CACHE", "~no-such-user/cache")
    with pytest.raises(InputError, match="IMPACTOPT_CACHE"):
        cache_directory()


# ---- processes

WORKER = """
import sys, time
from pathlib import Path
import casadi as ca
from impactopt.codegen.cache import FunctionGroup, cached, cached_groups
def build():
    with open(sys.argv[1], "a") as log:
        log.write("built\\n")
    while Path(sys.argv[2]).read_text().count("here") < 2:  # the other process comes
        time.sleep(0.01)
    time.sleep(0.2)  # and wants the function too
    x = ca.SX.sym("x", 3)
    return [ca.Function("value", [x], [2 * ca.sin(x) + x[0] * x])]
with open(sys.argv[2], "a") as log:
    log.write("here\\n")
print(repr(float(cached("toy", (1,), build)["value"]([0.3, -1.2, 2.5])[1])))
"""


@needs_compiler
def test_two_processes_at_once_build_once(cache: Path, tmp_path: Path) -> None:
    log, arrivals = tmp_path / "log", tmp_path / "arrivals"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", "-c", WORKER, str(log), str(arrivals)]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env) for _ in range(2)]
    printed = [process.communicate(timeout=60)[0] for process in started]
    assert [process.returncode for process in started] == [0, 0]
    np.testing.assert_allclose([float(text) for text in printed], TRUE, rtol=1e-14)
    assert log.read_text() == "built\n"
    assert len(libraries(cache)) == 1
    assert not list(cache.glob("tmp-*")), "no scratch left behind"


def sine(name: str, before: Callable[[], object] = lambda: None) -> FunctionGroup:
    """A group of one function of its own, which does something first when it is built."""

    def build() -> list[ca.Function]:
        before()
        x = ca.SX.sym("x")
        return [ca.Function(name, [x], [ca.sin(len(name) * x)], ["x"], ["y"])]

    return FunctionGroup(name=name, recipe=(), build=build)


@needs_compiler
def test_a_group_is_built_while_another_is_compiled(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    second, run = threading.Event(), Compiler.run

    def patient(self: Compiler, source: Path, library: Path, level: str) -> None:
        assert second.wait(30), "the second group waits for the first one to be compiled"
        run(self, source, library, level)

    monkeypatch.setattr(Compiler, "run", patient)
    functions = cached_groups([sine("one"), sine("others", second.set)])
    assert [f.class_name() for f in functions.values()] == ["External", "External"]
    assert [float(f(0.3)) for f in functions.values()] == pytest.approx([np.sin(0.9), np.sin(1.8)])


@needs_compiler
def test_nothing_is_held_while_another_process_is_waited_for(cache: Path) -> None:
    """Two processes that begin with one group each, and then want the other's, would wait for ever."""
    one, other = sine("one"), sine("others")
    cached_groups([other])
    (listing,) = cache.glob("others-*.json")
    listing.unlink()
    theirs = contextlib.ExitStack()
    theirs.enter_context(private_files.locked(listing.with_suffix(".lock"), on_wait=lambda: None))
    finished: list[list[str]] = []

    def report(line: str) -> None:
        if "another process" in line:
            finished.append([path.name.partition("-")[0] for path in cache.glob("*.json")])
            with private_files.locked(next(cache.glob("one-*.lock")), on_wait=lambda: finished.append([])):
                theirs.close()

    functions = cached_groups([one, other], report=report)
    assert list(functions) == ["one", "others"]
    assert finished == [["one"]]


@needs_compiler
def test_failed_build_leaves_nothing_and_no_lock(cache: Path) -> None:
    def interrupted() -> list[ca.Function]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cached("toy", (1,), interrupted)
    assert not list(cache.glob("*.json")) and not libraries(cache)
    assert value(cached("toy", (1,), Builder())) == pytest.approx(TRUE, rel=1e-14)


# ---- damage


def replace(path: Path, content: bytes) -> None:
    """New content in a new file: the old one may still be mapped."""
    mode = path.stat().st_mode
    path.unlink()
    path.write_bytes(content)
    path.chmod(mode)


@needs_compiler
@pytest.mark.parametrize(
    "damage",
    [
        lambda cache: replace(libraries(cache)[1], libraries(cache)[1].read_bytes()[:1000]),
        lambda cache: replace(libraries(cache)[1], b"not a library"),
        lambda cache: libraries(cache)[1].unlink(),
        lambda cache: replace(entry(cache), b'{"functions": {"value": ["va'),
        lambda cache: replace(entry(cache), b"[]"),
        lambda cache: entry(cache).unlink(),
        lambda cache: [replace(libraries(cache)[1], b"not a library"), entry(cache).unlink()],
        lambda cache: [path.unlink() for path in cache.glob("*.sha256")] + [entry(cache).unlink()],
    ],
    ids=[
        "truncated",
        "garbage",
        "missing",
        "cut listing",
        "wrong listing",
        "no listing",
        "garbage and no listing",
        "no seals",
    ],
)
def test_damage_is_mended(filled: Path, damage: Callable[[Path], object]) -> None:
    build = Builder()
    good = {path.name: path.stat().st_size for path in libraries(filled)}
    damage(filled)
    assert value(cached("toy", (1,), build)) == pytest.approx(TRUE, rel=1e-14)
    assert build.calls == 1
    assert {path.name: path.stat().st_size for path in libraries(filled)} == good
    cached("toy", (1,), build)
    assert build.calls == 1, "fixed for good"


# ---- privacy


@pytest.fixture
def poisoned(filled: Path, compiled: Path) -> Path:
    """A library of other values in the place of the good one, listed as it should be."""
    (bad,) = (compiled / "bad").glob("value-*.so")
    (good,) = filled.glob("value-*.so")
    digest = hashlib.sha256(bad.read_bytes()).hexdigest()
    replace(good, bad.read_bytes())
    replace(good.with_suffix(".sha256"), digest.encode())
    listing = json.loads(entry(filled).read_text())
    listing["functions"]["value"][1] = digest
    replace(entry(filled), json.dumps(listing).encode())
    return good


@needs_compiler
@pytest.mark.usefixtures("poisoned")
def test_poison_would_work_if_it_were_private() -> None:
    """So that the tests below, where it must not, can fail."""
    assert value(cached("toy", (1,), Builder())) == pytest.approx(666 * np.sin(X[1]) + X[0] * X[1])


@needs_compiler
@pytest.mark.parametrize("mode", [0o720, 0o702])
@pytest.mark.parametrize("part", ["library", "listing"])
def test_file_that_others_can_write_is_not_loaded(cache: Path, poisoned: Path, mode: int, part: str) -> None:
    loose = poisoned if part == "library" else entry(cache)
    loose.chmod(mode)
    if part == "listing":  # the library is then what its seal says: of other C code, so take the seal away
        poisoned.with_suffix(".sha256").unlink()
    build = Builder()
    with pytest.warns(CacheWarning, match=r"is writable by others; run: chmod go-w .*; compiling again"):
        functions = cached("toy", (1,), build)
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)
    assert build.calls == 1
    assert loose.stat().st_mode & 0o022 == 0, "replaced by a file of our own"


@needs_compiler
@pytest.mark.usefixtures("poisoned")
@pytest.mark.parametrize("mode", [0o770, 0o707])
def test_directory_that_others_can_write_is_not_used(cache: Path, mode: int) -> None:
    before = sorted(path.name for path in cache.iterdir())
    cache.chmod(mode)
    with pytest.warns(CacheWarning, match=r"cache is writable by others; run: chmod go-w .*temporary"):
        functions = cached("toy", (1,), Builder())
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)
    assert sorted(path.name for path in cache.iterdir()) == before


@needs_compiler
@pytest.mark.usefixtures("poisoned")
def test_directory_in_a_place_where_others_can_replace_it_is_not_used(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.warns(CacheWarning, match=r"above .* is writable by others"):
        assert value(cached("toy", (1,), Builder())) == pytest.approx(TRUE, rel=1e-14)
    tmp_path.chmod(0o1777)  # sticky, as /tmp: others cannot rename what is ours
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cached("toy", (1,), Builder())


@needs_compiler
def test_links_are_not_followed(
    cache: Path, poisoned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aside = tmp_path / "aside.so"
    poisoned.rename(aside)
    poisoned.symlink_to(aside)
    with pytest.warns(CacheWarning, match="is not a plain file"):
        assert value(cached("toy", (1,), Builder())) == pytest.approx(TRUE, rel=1e-14)
    assert not poisoned.is_symlink() and aside.exists()
    link = tmp_path / "link"
    link.symlink_to(cache)
    monkeypatch.setenv("IMPACTOPT_CACHE", str(link))
    with pytest.warns(CacheWarning, match="link is a symbolic link"):
        cached("toy", (1,), Builder())


@needs_compiler
def test_files_of_another_user_are_not_loaded(poisoned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lstat = os.lstat

    def foreign(path: Path, **options: int) -> os.stat_result:
        status = list(lstat(path, **options))
        if path == poisoned:
            status[4] = os.getuid() + 1
        return os.stat_result(status)

    monkeypatch.setattr(private_files.os, "lstat", foreign)
    with pytest.warns(CacheWarning, match="belongs to another user"):
        functions = cached("toy", (1,), Builder())
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)


@needs_compiler
def test_everything_made_is_private(cache: Path) -> None:
    old = os.umask(0)
    try:
        cached("toy", (1,), Builder())
    finally:
        os.umask(old)
    for path in (cache, *cache.iterdir()):
        assert path.stat().st_mode & 0o077 == 0, path


# ---- without a compiler


@pytest.mark.parametrize(
    ("variable", "content", "why"),
    [
        ("IMPACTOPT_NO_COMPILER", "1", "IMPACTOPT_NO_COMPILER is set"),
        ("CC", "no-such-compiler", "install gcc or clang, or name one in the environment variable CC"),
        # it says which version it is, and compiles nothing
        ("CC", "cc -fno-such-flag", r"cc -fno-such-flag failed on trial.c .*; fix it, or what CC names"),
    ],
)
def test_without_compiler_the_virtual_machine_and_one_warning(
    cache: Path, monkeypatch: pytest.MonkeyPatch, variable: str, content: str, why: str
) -> None:
    monkeypatch.setenv(variable, content)
    codegen._warn_no_compiler.cache_clear()
    with pytest.warns(NoCompilerWarning, match=why):
        functions = cached("toy", (1,), Builder())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cached("toy", (1,), Builder())
    assert functions["value"].class_name() == "SXFunction"
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)
    assert not cache.exists()


@needs_compiler
@pytest.mark.parametrize("listing", ['{"functions": {}}', '{"functions": 1}', "[]", "{}"])
def test_an_entry_of_nothing_is_made_again(filled: Path, listing: str) -> None:
    entry(filled).write_text(listing)
    again = Builder()
    assert value(cached("toy", (1,), again)) == pytest.approx(TRUE, rel=1e-14)
    assert again.calls == 1


@needs_compiler
def test_a_lock_that_is_none_is_gone_round(filled: Path) -> None:
    for path in filled.iterdir():
        path.unlink()
        if path.suffix == ".lock":
            path.mkdir()
    with pytest.warns(CacheWarning, match="cannot be locked"):
        functions = cached("toy", (1,), Builder())
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)


@needs_compiler
def test_an_empty_library_with_its_seal_is_made_again(filled: Path) -> None:
    for path in filled.iterdir():
        if path.suffix == ".so":
            path.write_bytes(b"")
            path.with_suffix(".sha256").write_text(hashlib.sha256(b"").hexdigest())
        elif path.suffix == ".json":
            path.unlink()
    assert value(cached("toy", (1,), Builder())) == pytest.approx(TRUE, rel=1e-14)


@needs_compiler
def test_a_library_that_cannot_be_loaded_costs_only_time(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def external(*_arguments: object) -> None:
        raise RuntimeError("failed to map segment from shared object")

    monkeypatch.setattr(codegen.ca, "external", external)
    with pytest.warns(NoCompilerWarning, match="cannot be loaded .*failed to map segment"):
        functions = cached("toy", (1,), Builder())
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)


@needs_compiler
def test_a_place_that_allows_no_code_is_not_used(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(directory, "allows_code", lambda path: path != cache)
    with pytest.warns(CacheWarning, match="noexec"):
        functions = cached("toy", (1,), Builder())
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)
    assert not list(cache.iterdir())


@needs_compiler
def test_a_cache_that_cannot_be_made_gets_one_warning_with_the_remedy(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("IMPACTOPT_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.warns(CacheWarning) as warned:
        for name in ("toy", "another"):
            assert value(cached(name, (1,), Builder())) == pytest.approx(TRUE, rel=1e-14)
    (message,) = (str(one.message) for one in warned)
    assert f"cannot use {tmp_path / 'file' / 'cache'}" in message and "set IMPACTOPT_CACHE" in message


@needs_compiler
def test_what_killed_compilations_have_left_is_swept(cache: Path) -> None:
    cache.mkdir(mode=0o700)
    left, others = [cache / "tmp-old", cache / ".toy.json.0a.tmp"], [cache / "tmp-new", cache / "kept"]
    (cache / "tmp-old").mkdir()
    (cache / "tmp-old" / "value.c").touch()
    for path in (left[1], *others):
        path.touch()
    for path in (*left, cache / "kept"):
        os.utime(path, (0, 0))
    cached("toy", (1,), Builder())
    assert not any(path.exists() for path in left) and all(path.exists() for path in others)


@needs_compiler
def test_compiler_that_fails_is_quoted(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "cc"
    script.write_text(
        "#!/bin/sh\n"
        '[ "$1" = --version ] && echo fake 1 && exit 0\n'
        'case "$*" in *trial.c*) exec cc "$@";; esac\n'
        'echo "value.c: error: disk full" >&2\n'
        'echo "  ^~~" >&2\n'
        "exit 3\n"
    )
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    with pytest.warns(
        NoCompilerWarning,
        match=r"toy: .*cc failed on \w+.c \(code 3\): .*: disk full; its functions run in",
    ):
        functions = cached("toy", (1,), Builder())
    assert value(functions) == pytest.approx(TRUE, rel=1e-14)
    assert not list(cache.glob("*.json"))


# ---- models


def test_model_hash_is_the_same_in_another_process() -> None:
    code = (
        "from support.one_joint import model; from impactopt.codegen.cache import model_hash; "
        "print(model_hash(model()))"
    )
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        "PYTHONHASHSEED": "7",
    }
    printed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True
    )
    assert printed.stdout.strip() == model_hash(model())


def _armature(m: pin.Model) -> None:
    m.armature[1] = 0.1


def _mass(m: pin.Model) -> None:
    m.inertias[2] = pin.Inertia(2.1, m.inertias[2].lever, m.inertias[2].inertia)


def _placement(m: pin.Model) -> None:
    m.jointPlacements[2] = pin.SE3(np.eye(3), np.array([0.1, 0.2, 0.31]))


def _frame(m: pin.Model) -> None:
    m.frames[m.getFrameId("tip")].placement = pin.SE3(np.eye(3), np.array([0, 0, 0.41]))


def _gravity(m: pin.Model) -> None:
    m.gravity.linear = np.array([0, 0, -1.62])


def _axis(m: pin.Model) -> None:
    joint = pin.JointModelRevoluteUnaligned(0, 0.8, 0.6)
    joint.setIndexes(2, 1, 1)
    m.joints[2] = joint


@pytest.mark.parametrize("change", [_armature, _mass, _placement, _frame, _gravity, _axis])
def test_model_hash_sees_what_shapes_the_dynamics(change: Callable[[pin.Model], None]) -> None:
    changed = model()
    change(changed)
    assert model_hash(changed) != model_hash(model())


def test_model_hash_leaves_limits_out() -> None:
    changed = model()
    changed.upperPositionLimit[:] = 1
    assert model_hash(changed) == model_hash(model())


@pytest.mark.parametrize("room", ["cli", "files", "planning", "report", "sweeps"])
def test_an_edit_that_shapes_no_function_leaves_all_of_them(
    room: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "impactopt"
    kept = shutil.ignore_patterns("__pycache__", "*.js", "*.html")
    shutil.copytree(ROOT / "impactopt", package, ignore=kept)
    monkeypatch.setattr(codegen, "__file__", str(package / "codegen" / "cache.py"))
    key = codegen._sources_key.__wrapped__
    before = key()
    for file in (package / room).rglob("*.py"):
        file.write_text("# edited\n", encoding="utf-8")
    assert key() == before
    (package / "collision" / "sdc.py").write_text("# edited\n", encoding="utf-8")
    assert key() != before
