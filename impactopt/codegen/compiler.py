"""The C compiler: which one, for which CPU, and turning one C file into one library."""

from __future__ import annotations

import functools
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca

from impactopt.errors import InputError

__all__ = ["CompileError", "Compiler", "find_compiler", "why_no_compiler"]

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
        return "\0".join([ca.__version__, *self.command, self.version, *_FLAGS, platform.machine(), _cpu()])

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
    for command in _candidates():
        version = _version(command)
        if version and not _trouble(Compiler(command=command, version=version)):
            return Compiler(command=command, version=version)
    return None


def why_no_compiler() -> str:
    """Reason why `find_compiler` has found none, in a few words."""
    if _forbidden():
        return "IMPACTOPT_NO_COMPILER is set" if os.name == "posix" else "there is none for this system"
    for command in _candidates():
        version = _version(command)
        if version and (trouble := _trouble(Compiler(command=command, version=version))):
            return f"{trouble}; fix it, or what CC names"
    return "install gcc or clang, or name one in the environment variable CC"


def _forbidden() -> bool:
    return os.environ.get("IMPACTOPT_NO_COMPILER", "") not in ("", "0") or os.name != "posix"


def _candidates() -> list[tuple[str, ...]]:
    given = os.environ.get("CC", "")
    try:
        wanted = shlex.split(given)
    except ValueError as error:
        raise InputError(f"the environment variable CC is {given!r}, which is no command: {error}") from None
    names = [wanted] if wanted else [["cc"], ["gcc"], ["clang"]]
    found = [(shutil.which(words[0]), words[1:]) for words in names]
    return [(program, *rest) for program, rest in found if program]


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
