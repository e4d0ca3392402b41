"""CasADi functions compiled to C and kept on disk, safe for two processes at once and private to the user.

Compiled, a rigid-body function runs 8 to 23 times faster than in CasADi's virtual machine, but compiling
costs from a second to a minute. There are two levels of keys:

* an *entry* (`<name>-<key>.json`) is found without building any graph: its key covers what the caller says it
  built (`recipe`), this package's sources, CasADi, compiler, flags and CPU. It lists the functions and their
  libraries;
* a *library* (`<function>-<hash>.so`) is named after the C code in it, so that a change of the sources that
  leaves the graph alone costs building the graph again, but no compilation.

A library that someone else could have written is never loaded: see `impactopt.codegen.private_files`.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import casadi as ca

from impactopt.codegen.compiler import CompileError, Compiler, find_compiler, why_no_compiler
from impactopt.codegen.directory import put, slug, usable_directory, warn
from impactopt.codegen.hashing import canonical
from impactopt.codegen.library import (
    MAX_OPTIMIZED,
    Buildable,
    NativeCode,
    c_code,
    library_of,
    longest_body,
    name_of,
)
from impactopt.codegen.private_files import (
    UnsafePath,
    check_private_file,
    locked,
    temporary_private_directory,
)
from impactopt.errors import NoCompilerWarning

__all__ = ["cached", "library_path"]

Report = Callable[[str], None]

# Rooms whose sources can shape a graph: a change in one of them builds all functions anew, elsewhere none.
_IN_GRAPHS = frozenset(
    ("codegen", "collision", "contact", "kinematics", "problem", "robots", "transcription")
)


def cached(
    name: str,
    recipe: tuple[Any, ...],
    build: Callable[[], Sequence[Buildable]],
    *,
    report: Report | None = None,
) -> dict[str, ca.Function]:
    """Functions by name: loaded from the cache, or built, compiled and put there.

    Derivatives have to be among the functions that `build` returns: a loaded function cannot be
    differentiated.

    Parameters
    ----------
    name : of the group of functions, for file names and messages.
    recipe : everything but this package's sources that shapes the functions: numbers, text, arrays, enums,
        dataclasses, and tuples or mappings of them; for a model, its `model_hash`.
    build : makes the functions, as graphs or as `NativeCode`; only called when the cache has no valid copy.
    report : told what is going on, one line a call, while functions are compiled.

    Returns
    -------
    The functions by their own names, in `build`'s order. Without a C compiler, or with
    IMPACTOPT_NO_COMPILER=1 in the environment, they run in CasADi's virtual machine and a NoCompilerWarning
    says so once a process.
    """
    tell = report if report is not None else _ignore
    compiler = find_compiler()
    if compiler is None:
        _warn_no_compiler()
        return _graphs(_by_name(build()))
    entry = f"{slug(name)}-{_entry_key(name, recipe, compiler)}"

    def waits() -> None:
        tell(f"{name}: another process is compiling, waiting")

    def found(directory: Path) -> dict[str, ca.Function]:
        functions = _load_entry(directory, entry)
        if functions is None:
            with locked(directory / f"{entry}.lock", on_wait=waits):
                functions = _load_entry(directory, entry)
                if functions is None:
                    functions = _build_entry(directory, entry, name, build, compiler, tell)
        return functions

    try:
        return found(usable_directory())
    except UnsafePath as error:
        warn(f"{error}; compiling into a temporary directory, for this process only")
        return found(temporary_private_directory())


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
        functions = {}
        for function, (library, digest) in listing["functions"].items():
            if Path(library).name != library:
                return None
            path = directory / library
            check_private_file(path)
            if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
                return None
            functions[function] = ca.external(function, str(path))
        return functions or None
    except UnsafePath as error:
        warn(f"{error}; compiling again")
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError):
        return None


def _build_entry(
    directory: Path,
    entry: str,
    name: str,
    build: Callable[[], Sequence[Buildable]],
    compiler: Compiler,
    tell: Report,
) -> dict[str, ca.Function]:
    start = time.monotonic()
    tell(f"{name}: building the functions")
    functions = _by_name(build())
    listing: dict[str, tuple[str, str]] = {}
    pool = ThreadPoolExecutor(max_workers=os.cpu_count() or 1)
    try:
        with tempfile.TemporaryDirectory(dir=directory, prefix="tmp-") as scratch, pool:
            jobs = {}
            try:
                # the longest first, so that the cores finish together; CasADi itself stays in this thread
                for function in sorted(functions.values(), key=longest_body, reverse=True):
                    job = pool.submit(library_of, directory, Path(scratch), *c_code(function), compiler)
                    jobs[job] = name_of(function)
                for done, job in enumerate(as_completed(jobs), start=1):
                    listing[jobs[job]] = job.result()
                    seconds = time.monotonic() - start
                    tell(f"{name}: compiled {jobs[job]} ({done} of {len(jobs)}, {seconds:.0f} s)")
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        ordered = {"functions": {function: listing[function] for function in functions}}
        put(directory / f"{entry}.json", json.dumps(ordered, indent=1).encode())
    except (CompileError, OSError) as error:
        warnings.warn(
            f"{name}: {error}; its functions run in CasADi's virtual machine or in NumPy, 10 to 100 times "
            "slower",
            NoCompilerWarning,
            stacklevel=4,
        )
        return _graphs(functions)
    try:
        return {f: ca.external(f, str(directory / listing[f][0])) for f in functions}
    except RuntimeError as error:
        said = str(error).strip().splitlines()[-1]
        warnings.warn(
            f"{name}: what was compiled cannot be loaded ({said}); its functions run in CasADi's virtual "
            "machine, 10 to 20 times slower",
            NoCompilerWarning,
            stacklevel=4,
        )
        return _graphs(functions)


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


def _ignore(message: str) -> None:
    pass
