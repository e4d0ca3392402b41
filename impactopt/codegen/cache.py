"""CasADi functions compiled to C and kept on disk, safe for two processes at once and private to the user.

Compiled, a rigid-body function runs 8 to 23 times faster than in CasADi's virtual machine, but compiling
costs from a second to a minute. There are two levels of keys:

* an *entry* (`<name>-<key>.json`) is found without building any graph: its key covers what the caller says it
  built (`recipe`), this package's sources, CasADi, compiler, flags and CPU. It lists the functions and their
  libraries;
* a *library* (`<function>-<hash>.so`) is named after the C code in it, so that a change of the sources that
  leaves the graph alone costs building the graph again, but no compilation.

A library that someone else could have written is never loaded: see `impactopt.storage.private_files`.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import json
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import casadi as ca
import numpy.typing as npt

from impactopt.codegen.compiler import CompileError, Compiler, find_compiler, why_no_compiler
from impactopt.errors import CacheWarning, InputError, NoCompilerWarning
from impactopt.storage.files import write_atomically
from impactopt.storage.hashing import canonical, model_hash
from impactopt.storage.private_files import (
    UnsafePath,
    allows_code,
    check_private_file,
    locked,
    private_directory,
    sweep_away,
    temporary_private_directory,
)

__all__ = [
    "NativeCode",
    "address",
    "cache_directory",
    "cached",
    "kept",
    "library_path",
    "model_hash",
    "native_library",
]

Report = Callable[[str], None]

# Rooms whose sources can shape a graph: a change in one of them builds all functions anew, elsewhere none.
_IN_GRAPHS = frozenset(
    ("codegen", "collision", "contact", "kinematics", "problem", "rigid_body", "robots", "transcription")
)
# gcc -O1 allocates registers in more than linear time: 6, 18, 71 s for 16, 47, 118 thousand instructions.
# Beyond this many, -O0: compiled ten times sooner, two to three times slower, but 5 times faster than the VM.
_MAX_OPTIMIZED = 60_000
# [s] from which on an unfinished compilation is one that was killed: no single function takes so long
_LEFT_BEHIND = 24 * 3600.0
# Loops over vectors gain from all that keeps the order of sums; -ffast-math would not keep it, nor NaN.
_NATIVE_LEVEL = "-O3 -fvisibility=hidden -ffp-contract=fast -fno-math-errno -fno-trapping-math"


@dataclass(frozen=True, kw_only=True)
class NativeCode:
    """A function whose C code is not CasADi's, but keeps to the interface that `ca.external` asks for.

    Attributes
    ----------
    name : of the function.
    code : C, one translation unit.
    level : of optimization, as the compiler's flags.
    graph : builds the function that takes its place where there is no compiler.
    """

    name: str
    code: str
    graph: Callable[[], ca.Function]
    level: str = _NATIVE_LEVEL


Buildable = Any  # ca.Function or NativeCode


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
    entry = f"{_slug(name)}-{_entry_key(name, recipe, compiler)}"

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
        return found(_directory())
    except UnsafePath as error:
        _warn(f"{error}; compiling into a temporary directory, for this process only")
        return found(temporary_private_directory())


def native_library(package: str, name: str) -> Any:
    """The library of ``native/NAME.c`` in a package, loaded; None where no compiler can make it."""
    compiler = find_compiler()
    if compiler is None:
        return None
    code = files(f"{package}.native").joinpath(f"{name}.c").read_text(encoding="utf-8")
    directory = _directory()
    try:
        with (
            locked(directory / f"{_slug(name)}.lock", on_wait=lambda: None),
            tempfile.TemporaryDirectory(dir=directory, prefix="tmp-") as scratch,
        ):
            path = _library(directory, Path(scratch), name, code, _NATIVE_LEVEL, compiler)[0]
            return ctypes.CDLL(str(directory / path))
    except (CompileError, OSError, UnsafePath) as error:
        warnings.warn(f"{name}: {error}; its work is done in Python", NoCompilerWarning, stacklevel=3)
        return None


def address(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    """Of an array's numbers, for C."""
    return ctypes.c_void_p(array.ctypes.data)


def library_path(name: str, recipe: tuple[Any, ...], function: str) -> Path | None:
    """The library of one function that `cached` gave for this name and recipe, for entries of it that CasADi
    does not know; None where it runs in CasADi's virtual machine."""
    compiler = find_compiler()
    if compiler is None:
        return None
    directory = _directory()
    entry = f"{_slug(name)}-{_entry_key(name, recipe, compiler)}"
    if _load_entry(directory, entry) is None:
        return None
    listing = json.loads((directory / f"{entry}.json").read_text(encoding="utf-8"))
    return directory / str(listing["functions"][function][0])


def _directory() -> Path:
    """The cache, or where it cannot be used a directory of this process."""
    try:
        directory = private_directory(cache_directory())
        if not allows_code(directory):
            raise UnsafePath(
                f"{directory} is on a file system that no code can be loaded from (mounted noexec); set "
                "IMPACTOPT_CACHE to a directory elsewhere"
            )
        _sweep(directory)
        return directory
    except (UnsafePath, OSError) as error:
        _warn(f"{error}; compiling into a temporary directory, for this process only")
        return temporary_private_directory()


@functools.cache  # once a process
def _sweep(directory: Path) -> None:
    sweep_away(directory, ("tmp-*", ".*.tmp"), older=_LEFT_BEHIND)


def kept(kind: str, digest: str, make: Callable[[], bytes]) -> bytes:
    """Numbers that take long to find: from the cache, or made and put there.

    kind, digest : what they are called, and a hash of all that they depend on.
    """
    path = _directory() / f"{_slug(kind)}-{digest[:40]}"
    try:
        check_private_file(path)
        content = path.read_bytes()
        if hashlib.sha256(content[32:]).digest() == content[:32]:
            return content[32:]
    except (OSError, UnsafePath):
        pass  # not there yet
    made = make()
    with contextlib.suppress(OSError):  # a full disk: they are made again next time
        _put(path, hashlib.sha256(made).digest() + made)
    return made


def cache_directory() -> Path:
    """Where libraries are kept: $IMPACTOPT_CACHE, $XDG_CACHE_HOME/impactopt or ~/.cache/impactopt.

    Who has no home, as users of containers may, has a directory of his own among the temporary ones.

    Raises
    ------
    InputError : IMPACTOPT_CACHE begins with the home of a user that there is not.
    """
    own, base = os.environ.get("IMPACTOPT_CACHE"), Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        if own:
            return Path(own).expanduser().absolute()
        home = Path.home()
    except RuntimeError as error:
        if own:
            raise InputError(f"IMPACTOPT_CACHE is {own!r}: {error}; give a directory") from None
        home = Path()
    if base.is_absolute():  # a relative one is to be ignored, as freedesktop.org's specification says
        return base / "impactopt"
    if home.is_absolute() and home != Path(home.anchor):
        return home / ".cache" / "impactopt"
    return Path(tempfile.gettempdir()).absolute() / f"impactopt-{os.getuid()}"


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
        _warn(f"{error}; compiling again")
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
                for function in sorted(functions.values(), key=_longest_body, reverse=True):
                    job = pool.submit(_library, directory, Path(scratch), *_c_code(function), compiler)
                    jobs[job] = _name_of(function)
                for done, job in enumerate(as_completed(jobs), start=1):
                    listing[jobs[job]] = job.result()
                    seconds = time.monotonic() - start
                    tell(f"{name}: compiled {jobs[job]} ({done} of {len(jobs)}, {seconds:.0f} s)")
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
        ordered = {"functions": {function: listing[function] for function in functions}}
        _put(directory / f"{entry}.json", json.dumps(ordered, indent=1).encode())
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


def _c_code(function: Buildable) -> tuple[str, str, str]:
    """Name, C code and optimization level of a function."""
    if isinstance(function, NativeCode):
        return function.name, function.code, function.level
    name = str(function.name())
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": False})
    generator.add(function)
    level = "-O1" if _longest_body(function) <= _MAX_OPTIMIZED else "-O0"
    return name, str(generator.dump()), level


def _library(
    directory: Path, scratch: Path, name: str, code: str, level: str, compiler: Compiler
) -> tuple[str, str]:
    """File name and hash of the library of this C code: the one that is there, or a new one."""
    key = hashlib.sha256("\0".join([code, level, compiler.key]).encode()).hexdigest()
    library = directory / f"{_slug(name)}-{key[:32]}.so"
    seal = library.with_suffix(".sha256")
    try:
        check_private_file(library)
        check_private_file(seal)
        content = library.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if content and seal.read_text(encoding="ascii") == digest:
            return library.name, digest
    except (UnsafePath, OSError, ValueError):
        pass
    source, made = scratch / f"{name}.c", scratch / f"{name}.so"
    source.write_text(code, encoding="utf-8")
    compiler.run(source, made, level)
    content = made.read_bytes()
    if not content:
        raise CompileError(f"{compiler.command[0]} has made an empty library of {source.name}")
    digest = hashlib.sha256(content).hexdigest()
    _put(library, content, mode=0o700)
    _put(seal, digest.encode())
    return library.name, digest


def _put(path: Path, content: bytes, *, mode: int = 0o600) -> None:
    write_atomically(path, lambda file: file.write(content), mode=mode)


def _longest_body(function: Buildable) -> int:
    """Instructions in the longest of the C functions that `function` becomes."""
    if isinstance(function, NativeCode):
        return function.code.count("\n")
    parts = [function, *function.find_functions()]
    return max(
        (int(f.n_instructions()) for f in parts if f.class_name() in ("SXFunction", "MXFunction")), default=0
    )


def _name_of(function: Buildable) -> str:
    return function.name if isinstance(function, NativeCode) else str(function.name())


def _by_name(functions: Sequence[Buildable]) -> dict[str, Buildable]:
    named: dict[str, Buildable] = {}
    for function in functions:
        name = _name_of(function)
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
    text = "\0".join([name, canonical(recipe), str(_MAX_OPTIMIZED), _sources_key(), compiler.key])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _warn(message: str) -> None:
    warnings.warn(f"cache of compiled functions: {message}", CacheWarning, stacklevel=3)


def _slug(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_" else "_" for c in name)


def _ignore(message: str) -> None:
    pass
