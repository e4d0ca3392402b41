"""A collision and its derivatives as a library of its own, and as its C, for other processes and machines."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import casadi as ca

from impactopt.codegen.compiler import CompileError, find_compiler, why_no_compiler
from impactopt.collision.derivatives import Compile, Part, native_part, with_jacobian
from impactopt.collision.native import native_collision
from impactopt.collision.stepped import SteppedModel
from impactopt.errors import InputError

__all__ = ["export"]

_TAKEN = ("collision", "collision_gradient", "collision_jacobian", "collision_differences")
_SEEN = "-DGCC_HASCLASSVISIBILITY"  # of the function that CasADi writes, where nothing else is


def export(
    model: SteppedModel,
    whole: Any,
    parameters: tuple[str, ...],
    by: tuple[str, ...] | None,
    every: int,
    compiled: Compile,
    folder: Path,
    name: str,
) -> Path:
    """The library, from arguments as of `differentiable`; see `SymbolicModel.export`."""
    if not name.isidentifier() or name in _TAKEN or not ca.Function.check_name(name):
        raise InputError(f"name {name!r}: give a name for C that is none of {', '.join(_TAKEN)}")
    compiler = find_compiler()
    if compiler is None:
        raise InputError(f"export: it needs a C compiler that works; {why_no_compiler()}")
    native = native_collision(model, tuple(whole.name_out()), every=every)
    codes = {native.name: native.code}

    def derivatives(part: Part) -> tuple[Any, Mapping[str, Any]]:
        what, build = native_part(model, part, every)
        codes[part.name] = build().code
        function = compiled(part.name, what, build)
        return function, dict.fromkeys(function.name_in(), 1.0)

    functions = with_jacobian(model, whole, parameters, by, derivatives, name)
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": True})
    for function in functions if by is None or by else functions[:1]:
        generator.add(function)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        generator.generate(f"{folder.resolve()}/")
        sources = [folder / f"{name}.c"]
        for part, code in codes.items():
            sources.append(folder / f"{name}_{part}.c")
            sources[-1].write_text(code, encoding="utf-8")
        with tempfile.TemporaryDirectory(dir=folder, prefix="tmp-") as scratch:
            made = Path(scratch) / f"{name}.so"
            compiler.run(sources[0], made, f"{native.level} {_SEEN}", *sources[1:])
            return made.replace(folder / made.name).resolve()
    except (CompileError, OSError) as error:
        raise InputError(f"export to {folder}: {error}") from None
