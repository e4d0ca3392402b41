"""C code, CasADi's or one's own, as libraries in the cache."""

from __future__ import annotations

import ctypes
import hashlib
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import casadi as ca
import numpy.typing as npt

from impactopt.codegen.compiler import CompileError, Compiler, find_compiler
from impactopt.codegen.directory import put, slug, usable_directory
from impactopt.codegen.private_files import UnsafePath, check_private_file, locked
from impactopt.errors import NoCompilerWarning

__all__ = [
    "MAX_OPTIMIZED",
    "Buildable",
    "NativeCode",
    "address",
    "c_code",
    "library_of",
    "longest_body",
    "name_of",
    "native_library",
]

# gcc -O1 allocates registers in more than linear time: 6, 18, 71 s for 16, 47, 118 thousand instructions.
# Beyond this many, -O0: compiled ten times sooner, two to three times slower, but 5 times faster than the VM.
MAX_OPTIMIZED = 60_000
# Loops over vectors gain from all that keeps the order of sums; -ffast-math would not keep it, nor NaN.
_NATIVE_LEVEL = "-O3 -fvisibility=hidden -ffp-contract=fast -fno-math-errno -fno-trapping-math"


@dataclass(frozen=True, kw_only=True)
class NativeCode:
    """A function whose C code is not CasADi's, but keeps to the interface that `ca.external` asks for.

    Attributes
    ----------
    name : of the function.
    code : C, one translation unit, which may be that of other functions, too.
    level : of optimization, as the compiler's flags.
    graph : builds the function that takes its place where there is no compiler.
    """

    name: str
    code: str
    graph: Callable[[], ca.Function]
    level: str = _NATIVE_LEVEL


Buildable = Any  # ca.Function or NativeCode


def native_library(package: str, name: str) -> Any:
    """The library of ``native/NAME.c`` in a package, loaded; None where no compiler can make it."""
    compiler = find_compiler()
    if compiler is None:
        return None
    code = files(f"{package}.native").joinpath(f"{name}.c").read_text(encoding="utf-8")
    directory = usable_directory()
    try:
        with (
            locked(directory / f"{slug(name)}.lock", on_wait=lambda: None),
            tempfile.TemporaryDirectory(dir=directory, prefix="tmp-") as scratch,
        ):
            path = library_of(directory, Path(scratch), name, code, _NATIVE_LEVEL, compiler)[0]
            return ctypes.CDLL(str(directory / path))
    except (CompileError, OSError, UnsafePath) as error:
        warnings.warn(f"{name}: {error}; its work is done in Python", NoCompilerWarning, stacklevel=3)
        return None


def address(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    """Address of an array's numbers, for C."""
    return ctypes.c_void_p(array.ctypes.data)


def c_code(function: Buildable) -> tuple[str, str, str]:
    """Name, C code and optimization level of a function."""
    if isinstance(function, NativeCode):
        return function.name, function.code, function.level
    name = str(function.name())
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": False})
    generator.add(function)
    level = "-O1" if longest_body(function) <= MAX_OPTIMIZED else "-O0"
    return name, str(generator.dump()), level


def library_of(
    directory: Path, scratch: Path, name: str, code: str, level: str, compiler: Compiler
) -> tuple[str, str]:
    """File name and hash of the library of this C code: the one that is there, or a new one."""
    key = hashlib.sha256("\0".join([code, level, compiler.key]).encode()).hexdigest()
    library = directory / f"{slug(name)}-{key[:32]}.so"
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
    put(library, content, mode=0o700)
    put(seal, digest.encode())
    return library.name, digest


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
