"""The C compiler: which one, for which CPU, and turning one C file into one library."""

from __future__ import annotations

import functools
import os
import platform
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import casadi as ca

__all__ = ["CompileError", "Compiler", "find_compiler"]

_FLAGS = ("-march=native", "-fPIC", "-shared", "-w")


class CompileError(RuntimeError):
    """The compiler failed on a C file."""


@dataclass(frozen=True, kw_only=True)
class Compiler:
    """A C compiler that answered to --version."""

    command: tuple[str, ...]
    version: str

    @property
    def key(self) -> str:
        """Text that differs whenever a library made here could differ or not run."""
        return "\0".join([ca.__version__, *self.command, self.version, *_FLAGS, platform.machine(), _cpu()])

    def run(self, source: Path, library: Path, level: str) -> None:
        """Compile `source` into the shared `library` at an optimization level such as "-O1", or flags.

        Raises
        ------
        CompileError : with the compiler's first error.
        """
        command = [*self.command, *level.split(), *_FLAGS, str(source), "-o", str(library), "-lm"]
        result = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if result.returncode != 0:
            lines = result.stderr.strip().splitlines() or ["no message"]
            words = next((line for line in lines if "error" in line), lines[-1])
            program = shlex.join(self.command)
            raise CompileError(f"{program} failed on {source.name} (code {result.returncode}): {words}")


def find_compiler() -> Compiler | None:
    """$CC, or else cc, gcc or clang; None if there is none or IMPACTOPT_NO_COMPILER is set."""
    if os.environ.get("IMPACTOPT_NO_COMPILER", "") not in ("", "0") or os.name != "posix":
        return None
    wanted = shlex.split(os.environ.get("CC", ""))
    for words in [wanted] if wanted else [["cc"], ["gcc"], ["clang"]]:
        program = shutil.which(words[0])
        command = (program, *words[1:]) if program else None
        version = _version(command) if command else None
        if command and version:
            return Compiler(command=command, version=version)
    return None


@functools.cache
def _version(command: tuple[str, ...]) -> str | None:
    try:
        result = subprocess.run(
            [*command, "--version"], capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None if result.returncode == 0 else None


@functools.cache
def _cpu() -> str:
    """Model and features of the CPU: code made with -march=native for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return f"{platform.processor()} {platform.platform()}"
    wanted = {"model name", "flags", "Features", "CPU implementer", "CPU part"}
    return "\n".join(sorted({line for line in lines if line.split(":")[0].strip() in wanted}))
