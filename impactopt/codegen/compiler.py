"""C compiler, and C code, CasADi's or one's own, as libraries in the cache."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import casadi as ca
import numpy.typing as npt

from impactopt.codegen.files import UnsafePath, check_private_file, locked, put, slug, usable_directory
from impactopt.errors import InputError, NoCompilerWarning

_FLAGS = ("-march=native", "-fPIC", "-shared", "-w")
# what a compiler has to make a library of before it is taken for one
_TRIAL = "double impactopt_trial(double x) { return x + 1.0; }\n"
_PATIENCE = 20  # [s] for the trial
_LONGEST = 900  # [s] for a function: the longest of the presets takes a minute
_SAID = 1 << 20  # bytes of output that are read


class CompileError(RuntimeError):
    """The compiler failed on a C file."""


@dataclass(frozen=True, kw_only=True)
class Compiler:
    """A C compiler that has made a library."""

    command: tuple[str, ...]
    version: str

    @property
    def key(self) -> str:
        """Text that differs whenever a library made here could differ or not run."""
        text = [ca.__version__, *self.command, self.version, *_FLAGS, platform.machine(), _cpu()]
        return "\0".join([*text, "quick"] if quick_to_compile() else text)

    def run(self, source: Path, library: Path, level: str, *more: Path) -> None:
        """Compile `source`, and `more`, into the shared `library` at an optimization level such as "-O1", or
        flags.

        Raises
        ------
        CompileError : with the compiler's first error.
        """
        _compile(self, source, library, level, _LONGEST, *more)


def find_compiler() -> Compiler | None:
    """$CC, or else cc, gcc or clang; None if there is none that compiles, or IMPACTOPT_NO_COMPILER is set.

    To answer to --version is no proof: each is tried on a small file once a process.

    Raises
    ------
    InputError : CC is no command.
    """
    if _forbidden():
        return None
    return next((compiler for compiler, trouble in _tried() if not trouble), None)


def why_no_compiler() -> str:
    """Reason why `find_compiler` has found none, in a few words."""
    if _forbidden():
        return "IMPACTOPT_NO_COMPILER is set" if os.name == "posix" else "there is none for this system"
    for _, trouble in _tried():
        if trouble:
            return f"{trouble}; fix it, or what CC names"
    return "install gcc or clang, or name one in the environment variable CC"


def _forbidden() -> bool:
    return os.environ.get("IMPACTOPT_NO_COMPILER", "") not in ("", "0") or os.name != "posix"


def quick_to_compile() -> bool:
    """True if IMPACTOPT_COMPILE is "quick": functions compile three times sooner, and run slower.

    Tests of mathematics set it: there a function runs a few times only.
    """
    return os.environ.get("IMPACTOPT_COMPILE", "") == "quick"


def _candidates() -> list[tuple[str, ...]]:
    given = os.environ.get("CC", "")
    try:
        wanted = shlex.split(given)
    except ValueError as error:
        raise InputError(f"the environment variable CC is {given!r}, which is no command: {error}") from None
    names = [wanted] if wanted else [["cc"], ["gcc"], ["clang"]]
    found = [(shutil.which(words[0]), words[1:]) for words in names]
    return [(program, *rest) for program, rest in found if program]


def _tried() -> Iterator[tuple[Compiler, str]]:
    """Compilers that answer, each with the reason why it cannot be used, or ""."""
    for command in _candidates():
        if version := _version(command):
            compiler = Compiler(command=command, version=version)
            yield compiler, _trouble(compiler)


@functools.cache
def _trouble(compiler: Compiler) -> str:
    """Reason why a compiler cannot be used, or ""."""
    try:
        with tempfile.TemporaryDirectory(prefix="impactopt-") as scratch:
            source, library = Path(scratch) / "trial.c", Path(scratch) / "trial.so"
            source.write_text(_TRIAL, encoding="ascii")
            _compile(compiler, source, library, "-O1", _PATIENCE)
            return "" if library.stat().st_size else f"{shlex.join(compiler.command)} leaves an empty library"
    except (CompileError, OSError) as error:
        return str(error)


def _compile(
    compiler: Compiler, source: Path, library: Path, level: str, patience: float, *more: Path
) -> None:
    """Compiles (`Compiler.run`) in no more than `patience` [s]."""
    program = shlex.join(compiler.command)
    sources = [str(path) for path in (source, *more)]
    command = [*compiler.command, *level.split(), *_FLAGS, *sources, "-o", str(library), "-lm"]
    try:
        code, said = _run(command, patience)
    except subprocess.TimeoutExpired:
        raise CompileError(f"{program} has not answered within {patience} s") from None
    if code != 0:
        lines = said.strip().splitlines() or ["no message"]
        words = next((line for line in lines if "error" in line), lines[-1])
        raise CompileError(f"{program} failed on {source.name} (code {code}): {words}")


@functools.cache
def _version(command: tuple[str, ...]) -> str | None:
    try:
        code, said = _run([*command, "--version"], _PATIENCE)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return said.strip() or None if code == 0 else None


def _run(command: Sequence[str], seconds: float) -> tuple[int, str]:
    """Exit code and output of a command; subprocess.TimeoutExpired after so long.

    Its output goes to a file: a pipe ends only when all that the command has started have let go of it.
    """
    with tempfile.TemporaryFile() as out:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, timeout=seconds, check=False
        )
        out.seek(0)
        return done.returncode, out.read(_SAID).decode(errors="replace")


@functools.cache
def _cpu() -> str:
    """Model and features of the CPU: code made with -march=native for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.processor()} {platform.platform()}"
    wanted = {"model name", "flags", "Features", "CPU implementer", "CPU part"}
    return "\n".join(sorted({line for line in lines if line.split(":")[0].strip() in wanted}))


# gcc -O1 allocates registers in more than linear time: 6, 18, 71 s for 16, 47, 118 thousand instructions.
# Beyond this many, -O0: compiled ten times sooner, two to three times slower, but 5 times faster than the VM.
MAX_OPTIMIZED = 60_000
# Loops over vectors gain from all that keeps the order of sums; -ffast-math would not keep it, nor NaN.
NATIVE_FLAGS = "-fvisibility=hidden -ffp-contract=fast -fno-math-errno -fno-trapping-math"
_NATIVE_LEVEL = f"-O3 {NATIVE_FLAGS}"


def _level() -> str:
    return f"-O0 {NATIVE_FLAGS}" if quick_to_compile() else _NATIVE_LEVEL


@dataclass(frozen=True, kw_only=True)
class SharedCode:
    """C code that is compiled once, and becomes part of the library of every function that calls it.

    Attributes
    ----------
    name : for the file's name.
    code : C, one translation unit, whose functions are hidden outside of a library; their linkage is SHARED.
    level : of optimization, as the compiler's flags.
    """

    name: str
    code: str
    level: str


@dataclass(frozen=True, kw_only=True)
class NativeCode:
    """A function whose C code is not CasADi's, but keeps to the interface that `ca.external` asks for.

    Attributes
    ----------
    name : of the function.
    code : C, one translation unit, which may be that of other functions, too.
    level : of optimization, as the compiler's flags.
    graph : builds the function that takes its place where there is no compiler.
    shared : what it calls, if that is compiled for others too.
    """

    name: str
    code: str
    graph: Callable[[], ca.Function]
    level: str = field(default_factory=_level)
    shared: SharedCode | None = None

    @property
    def whole(self) -> str:
        """Code with what it shares as static functions, for a library that has several such codes."""
        return self.code if self.shared is None else f"#define SHARED static\n{self.shared.code}\n{self.code}"


Buildable = Any  # ca.Function or NativeCode


def native_library(package: str, name: str) -> Any:
    """The library of ``NAME.c`` in a package, loaded; None where no compiler can make it."""
    compiler = find_compiler()
    if compiler is None:
        return None
    code = files(package).joinpath(f"{name}.c").read_text(encoding="utf-8")
    directory = usable_directory()
    try:
        with (
            locked(directory / f"{slug(name)}.lock", on_wait=lambda: None),
            tempfile.TemporaryDirectory(dir=directory, prefix="tmp-") as scratch,
        ):
            source = Source(code=code, level=_NATIVE_LEVEL)
            path = library_of(directory, Path(scratch), name, source, compiler)[0]
            return ctypes.CDLL(str(directory / path))
    except (CompileError, OSError, UnsafePath) as error:
        warnings.warn(f"{name}: {error}; its work is done in Python", NoCompilerWarning, stacklevel=3)
        return None


def address(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    """Address of an array's numbers, for C."""
    return ctypes.c_void_p(array.ctypes.data)


@dataclass(frozen=True)
class Source:
    """All that a library is made of: C code, its level of optimization, and what is linked to it."""

    code: str
    level: str
    shared: SharedCode | None = None


def source_of(function: Buildable) -> Source:
    """C code of a function."""
    if isinstance(function, NativeCode):
        return Source(function.code, function.level, function.shared)
    generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False})
    generator.add(function)
    level = "-O0" if quick_to_compile() or longest_body(function) > MAX_OPTIMIZED else "-O1"
    return Source(str(generator.dump()), level)


def library_of(
    directory: Path, scratch: Path, name: str, source: Source, compiler: Compiler
) -> tuple[str, str]:
    """File name and hash of the library of this C code: the one that is there, or a new one."""
    shared = source.shared
    parts = [source.code, source.level, compiler.key]
    if shared is None:
        return _made(directory, scratch, f"{name}.so", parts, compiler, tuple)

    def linked() -> tuple[Path, ...]:
        code = [shared.code, f"{shared.level} -c", compiler.key]
        made = f"{shared.name}.o"
        # many functions that want it are compiled at once, and others of its name beside it
        with (
            locked(_file(directory, made, code).with_suffix(".lock"), on_wait=lambda: None),
            tempfile.TemporaryDirectory(dir=scratch) as own,
        ):
            return (directory / _made(directory, Path(own), made, code, compiler, tuple)[0],)

    return _made(directory, scratch, f"{name}.so", [*parts, shared.code, shared.level], compiler, linked)


def _file(directory: Path, name: str, parts: Sequence[str]) -> Path:
    """Place in the cache of what is compiled; name, parts : as of `_made`."""
    stem, suffix = os.path.splitext(name)
    key = hashlib.sha256("\0".join(parts).encode()).hexdigest()
    return directory / f"{slug(stem)}-{key[:32]}{suffix}"


def _made(
    directory: Path,
    scratch: Path,
    name: str,
    parts: Sequence[str],
    compiler: Compiler,
    linked: Callable[[], tuple[Path, ...]],
) -> tuple[str, str]:
    """File name and hash of what is compiled: what is there, or a new one.

    name : with the suffix of its kind.  parts : code, flags, and all else that it depends on.
    linked : object files that go into it.
    """
    file = _file(directory, name, parts)
    seal = file.with_suffix(".sha256")
    try:
        check_private_file(file)
        check_private_file(seal)
        content = file.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if content and seal.read_text(encoding="ascii") == digest:
            return file.name, digest
    except (UnsafePath, OSError, ValueError):
        pass
    made = scratch / name
    source = made.with_suffix(".c")
    source.write_text(parts[0], encoding="utf-8")
    compiler.run(source, made, parts[1], *linked())
    content = made.read_bytes()
    if not content:
        raise CompileError(f"{compiler.command[0]} has made an empty library of {source.name}")
    digest = hashlib.sha256(content).hexdigest()
    put(file, content, mode=0o700)
    put(seal, digest.encode())
    return file.name, digest


def longest_body(function: Buildable) -> int:
    """Instructions in the longest of the C functions that `function` becomes."""
    if isinstance(function, NativeCode):
        return function.code.count("\n")
    parts = [function, *function.find_functions()]
    return max(
        (int(f.n_instructions()) for f in parts if f.class_name() in ("SXFunction", "MXFunction")), default=0
    )


def name_of(function: Buildable) -> str:
    return function.name if isinstance(function, NativeCode) else str(function.name())
