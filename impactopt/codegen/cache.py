"""CasADi functions compiled to C and kept on disk, safe for two processes at once and private to the user.

Compiled, a rigid-body function runs 8 to 23 times faster than in CasADi's virtual machine, but compiling
costs from a second to a minute. There are three kinds of files, each with a key of its own:

* an *entry* (`<name>-<key>.json`) is found without building any graph: its key covers what the caller says it
  built (`recipe`), this package's sources, CasADi, compiler, flags and CPU. It lists the functions and their
  libraries;
* a *library* (`<function>-<hash>.so`) is named after the C code in it, so that a change of the sources that
  leaves the graph alone costs building the graph again, but no compilation;
* an *object file* (`<name>-<hash>.o`) is what several libraries have in common (`SharedCode`), and goes into
  each when it is made.

A library that someone else could have written is never loaded: see `impactopt.codegen.files`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import functools
import hashlib
import json
import logging
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impactopt.codegen.compiler import (
    MAX_OPTIMIZED,
    Buildable,
    CompileError,
    Compiler,
    NativeCode,
    Source,
    find_compiler,
    library_of,
    longest_body,
    name_of,
    source_of,
    why_no_compiler,
)
from impactopt.codegen.files import (
    UnsafePath,
    check_private_file,
    locked,
    put,
    slug,
    temporary_private_directory,
    usable_directory,
    warn,
)
from impactopt.errors import NoCompilerWarning


def model_hash(model: pin.Model, springs: Mapping[str, tuple[float, float]] | None = None) -> str:
    """Hexadecimal hash of all in a `pin.Model` that shapes its dynamics, the same in every process.

    Covers joints (name, type, axis, parent, placement), inertias, armature, gravity and frames; not limits.
    springs : of its joints, as of `Robot.springs`.
    """
    digest = hashlib.sha256()

    def add(*items: Any) -> None:
        for item in items:
            if isinstance(item, np.ndarray):
                digest.update(np.ascontiguousarray(item, dtype=np.float64).tobytes())
            digest.update(repr(np.shape(item) if isinstance(item, np.ndarray) else item).encode() + b"\0")

    add(int(model.nq), int(model.nv), np.array(model.gravity.vector))
    neutral = pin.neutral(model)
    for i in range(model.njoints):
        joint, inertia = model.joints[i], model.inertias[i]
        placement = model.jointPlacements[i].homogeneous
        add(str(model.names[i]), joint.shortname(), int(model.parents[i]), joint.idx_q, joint.idx_v)
        add(*_motion(joint, neutral) if i else (None,))
        add(np.array(placement), float(inertia.mass), np.array(inertia.lever), np.array(inertia.inertia))
    add(np.array(model.armature))
    for frame in model.frames:
        add(str(frame.name), int(frame.parentJoint), str(frame.type), np.array(frame.placement.homogeneous))
    for joint_name, spring in (springs or {}).items():
        add(joint_name, *spring)
    return digest.hexdigest()


def _motion(joint: Any, q: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Axes of a joint, (6, nv): the only way from Python to the axis of an unaligned one, and a follower's
    times its multiplier; of a follower also its placement at its offset.
    """
    data = joint.createData()
    joint.calc(data, q)
    return (np.array(data.S),) if joint.nv else (np.array(data.S), np.array(data.M.homogeneous))


def canonical(item: Any) -> str:
    """Text that is the same for equal recipes only, in every process."""
    if item is None or isinstance(item, bool | int | float | str | bytes):
        return repr(item)
    if isinstance(item, np.ndarray | np.generic):
        # repr would leave out the middle of a long array
        array = np.asarray(item)
        return f"array{array.shape}{array.dtype}{np.ascontiguousarray(array).tobytes().hex()}"
    if isinstance(item, tuple | list):
        return "(" + ",".join(map(canonical, item)) + ")"
    if isinstance(item, dict):
        return "{" + ",".join(sorted(f"{canonical(k)}:{canonical(v)}" for k, v in item.items())) + "}"
    if dataclasses.is_dataclass(item) and not isinstance(item, type):
        parts = {f.name: getattr(item, f.name) for f in dataclasses.fields(item)}
        return f"{type(item).__qualname__}{canonical(parts)}"
    if isinstance(item, enum.Enum):
        return f"{type(item).__qualname__}.{item.name}"
    raise TypeError(
        f"recipe: {type(item).__name__} is not supported; use numbers, text, arrays, tuples or dataclasses"
    )


_log = logging.getLogger("impactopt")
Report = Callable[[str], None]

# Rooms whose sources can shape a graph: a change in one of them builds all functions anew, elsewhere none.
_IN_GRAPHS = frozenset(
    ("codegen", "collision", "contact", "kinematics", "problem", "robots", "transcription")
)


@dataclass(frozen=True, kw_only=True)
class FunctionGroup:
    """Functions that are built together and kept as one entry.

    name : for file names and messages.
    recipe : everything but this package's sources that shapes the functions: numbers, text, arrays, enums,
        dataclasses, and tuples or mappings of them; for a model, its `model_hash`.
    build : makes the functions, as graphs or as `NativeCode`; only called when the cache has no valid copy.
        Those with the same C are compiled once.
        Derivatives have to be among them: a loaded function cannot be differentiated.
    """

    name: str
    recipe: tuple[Any, ...]
    build: Callable[[], Sequence[Buildable]]


def cached(
    name: str,
    recipe: tuple[Any, ...],
    build: Callable[[], Sequence[Buildable]],
    *,
    report: Report | None = None,
) -> dict[str, ca.Function]:
    """The functions of one `FunctionGroup`; see `cached_groups`."""
    return cached_groups([FunctionGroup(name=name, recipe=recipe, build=build)], report=report)


def cached_groups(groups: Sequence[FunctionGroup], *, report: Report | None = None) -> dict[str, ca.Function]:
    """Functions by name: loaded from the cache, or built, compiled and put there.

    While one group is compiled the next is built.

    report : called with a line of text for each step, while functions are compiled; None: the logger
        "impactopt", with level INFO.

    Returns
    -------
    The functions by their own names, in the order of the groups and of what `build` makes. Without a C
    compiler, or with IMPACTOPT_NO_COMPILER=1 in the environment, they run in CasADi's virtual machine and a
    NoCompilerWarning says so once a process.
    """
    report = _log.info if report is None else report
    compiler = find_compiler()
    if compiler is None:
        _warn_no_compiler()
        return {name: f for group in groups for name, f in _graphs(_by_name(group.build())).items()}
    try:
        return _found(usable_directory(), groups, compiler, report)
    except UnsafePath as error:
        warn(f"{error}; compiling into a temporary directory, for this process only")
        return _found(temporary_private_directory(), groups, compiler, report)


def _found(
    directory: Path, groups: Sequence[FunctionGroup], compiler: Compiler, report: Report
) -> dict[str, ca.Function]:
    """The functions of all groups in a directory, where those that are missing are put."""
    entries = [f"{slug(g.name)}-{_entry_key(g.name, g.recipe, compiler)}" for g in groups]
    found = [_load_entry(directory, entry) for entry in entries]
    if None in found:
        with contextlib.ExitStack() as held:
            locks = held.enter_context(contextlib.ExitStack())  # given back when no thread works any more
            pool = held.enter_context(ThreadPoolExecutor(max_workers=os.cpu_count() or 1))
            held.callback(pool.shutdown, cancel_futures=True)
            works: dict[int, _Work] = {}

            def finish() -> None:
                for k, work in works.items():
                    found[k] = work.finished()
                works.clear()

            for k, (group, entry) in enumerate(zip(groups, entries, strict=True)):
                if found[k] is not None:
                    continue

                def waits(name: str = group.name) -> None:
                    finish()  # of two processes none is to wait for what the other holds while it waits
                    report(f"{name}: another process is compiling, waiting")

                own = locks.enter_context(contextlib.ExitStack())
                own.enter_context(locked(directory / f"{entry}.lock", on_wait=waits))
                found[k] = _load_entry(directory, entry)
                if found[k] is None:
                    works[k] = _Work(directory, entry, group, compiler, pool, own, report)
                else:
                    own.close()
            finish()
    return {name: f for functions in found if functions is not None for name, f in functions.items()}


def library_path(name: str, recipe: tuple[Any, ...], function: str) -> Path | None:
    """The library of one function that `cached` gave for this name and recipe, for entries of it that CasADi
    does not know; None where it runs in CasADi's virtual machine."""
    compiler = find_compiler()
    if compiler is None:
        return None
    directory = usable_directory()
    entry = f"{slug(name)}-{_entry_key(name, recipe, compiler)}"
    if _load_entry(directory, entry) is None:
        return None
    listing = json.loads((directory / f"{entry}.json").read_text(encoding="utf-8"))
    return directory / str(listing["functions"][function][0])


def _load_entry(directory: Path, entry: str) -> dict[str, ca.Function] | None:
    """The functions of an entry, or None when any part of it is missing, damaged or not private."""
    try:
        check_private_file(directory / f"{entry}.json")
        listing = json.loads((directory / f"{entry}.json").read_text(encoding="utf-8"))
        for library, digest in {tuple(found) for found in listing["functions"].values()}:
            if Path(library).name != library:
                return None
            check_private_file(directory / library)
            if hashlib.sha256((directory / library).read_bytes()).hexdigest() != digest:
                return None
        functions = {
            f: ca.external(f, str(directory / found[0])) for f, found in listing["functions"].items()
        }
        return functions or None
    except UnsafePath as error:
        warn(f"{error}; compiling again")
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError):
        return None


class _Work:
    """A group that is built, and whose functions are being compiled by a pool's threads."""

    def __init__(
        self,
        directory: Path,
        entry: str,
        group: FunctionGroup,
        compiler: Compiler,
        pool: ThreadPoolExecutor,
        held: contextlib.ExitStack,
        report: Report,
    ) -> None:
        """held : what is to be given back when all is done, such as the entry's lock."""
        self._directory, self._entry, self._name, self._report = directory, entry, group.name, report
        self._start, self._held = time.monotonic(), held
        report(f"{group.name}: building the functions")
        self._functions = _by_name(group.build())
        self._jobs: dict[Future[tuple[str, str]], list[str]] = {}
        self._error: Exception | None = None
        try:
            scratch = Path(held.enter_context(tempfile.TemporaryDirectory(dir=directory, prefix="tmp-")))
        except OSError as error:
            self._error = error
            return
        # the longest first, so that the cores finish together; CasADi itself stays in this thread
        together: dict[Source, list[str]] = {}
        for function in sorted(self._functions.values(), key=longest_body, reverse=True):
            together.setdefault(source_of(function), []).append(name_of(function))
        for source, names in together.items():
            job = pool.submit(library_of, directory, scratch, names[0], source, compiler)
            self._jobs[job] = names

    def finished(self) -> dict[str, ca.Function]:
        """The functions, when all are compiled and in the cache; as CasADi runs them, where one cannot be."""
        with self._held:
            try:
                listing = self._compiled()
            except (CompileError, OSError) as error:
                for job in self._jobs:
                    job.cancel()
                wait(self._jobs)
                return self._uncompiled(
                    f"{error}; its functions run in CasADi's virtual machine or in NumPy, 10 to 100 times "
                    "slower"
                )
            try:
                return {f: ca.external(f, str(self._directory / listing[f][0])) for f in self._functions}
            except RuntimeError as error:
                said = str(error).strip().splitlines()[-1]
                return self._uncompiled(
                    f"what was compiled cannot be loaded ({said}); its functions run in CasADi's virtual "
                    "machine, 10 to 20 times slower"
                )

    def _compiled(self) -> dict[str, tuple[str, str]]:
        """Library and hash of each function, kept as an entry."""
        if self._error is not None:
            raise self._error
        listing: dict[str, tuple[str, str]] = {}
        for done, job in enumerate(as_completed(self._jobs), start=1):
            names, seconds = self._jobs[job], time.monotonic() - self._start
            listing |= dict.fromkeys(names, job.result())
            listed = ", ".join(names)
            self._report(f"{self._name}: compiled {listed} ({done} of {len(self._jobs)}, {seconds:.0f} s)")
        ordered = {"functions": {function: listing[function] for function in self._functions}}
        put(self._directory / f"{self._entry}.json", json.dumps(ordered, indent=1).encode())
        return listing

    def _uncompiled(self, why: str) -> dict[str, ca.Function]:
        warnings.warn(f"{self._name}: {why}", NoCompilerWarning, stacklevel=6)
        return _graphs(self._functions)


def _by_name(functions: Sequence[Buildable]) -> dict[str, Buildable]:
    named: dict[str, Buildable] = {}
    for function in functions:
        name = name_of(function)
        if name in named:
            raise ValueError(f"two functions of one group are named {name!r}")
        named[name] = function
    return named


def _graphs(functions: dict[str, Buildable]) -> dict[str, ca.Function]:
    """The functions as CasADi can run them itself."""
    return {name: f.graph() if isinstance(f, NativeCode) else f for name, f in functions.items()}


@functools.cache
def _warn_no_compiler() -> None:
    warnings.warn(
        "no C compiler: functions run in CasADi's virtual machine or in NumPy, 10 to 100 times slower; "
        f"{why_no_compiler()}",
        NoCompilerWarning,
        stacklevel=3,
    )


@functools.cache
def _sources_key() -> str:
    """Hash of this package's sources that can shape a graph."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for kind in ("*.py", "*.c", "*.h") for path in root.rglob(kind)):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[0] in _IN_GRAPHS:
            digest.update("/".join((*parts[:-1], path.name)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _entry_key(name: str, recipe: tuple[Any, ...], compiler: Compiler) -> str:
    text = "\0".join([name, canonical(recipe), str(MAX_OPTIMIZED), _sources_key(), compiler.key])
    return hashlib.sha256(text.encode()).hexdigest()[:32]
