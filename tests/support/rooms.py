"""The rooms of the package, in their order, and what its files import."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import impactopt

PACKAGE = Path(impactopt.__file__).parent

# Each room may import from those above it.
ROOMS_IN_ORDER = (
    "__init__",
    "arrays",
    "errors",
    "codegen",
    "contact",
    "robots",
    "kinematics",
    "collision",
    "bodies",
    "problem",
    "solvers",
    "transcription",
    "simulation",
    "planning",
    "files",
    "collide",
    "sweeps",
    "identification",
    "report",
    "api",
    "live",
    "cli",
    "__main__",
)
RANK = {room: rank for rank, room in enumerate(ROOMS_IN_ORDER)}
# Below the transcription all is numbers; IPOPT's adapter is the exception, as CasADi's wheel carries IPOPT.
NUMERIC = (
    "bodies",
    "kinematics/operational_space.py",
    "kinematics/inverse_kinematics.py",
    "kinematics/splines.py",
    "kinematics/stance.py",
    "planning/clearance_constraints.py",
    "planning/solution.py",
    "simulation",
    "solvers/elimination",
    "solvers/ipm",
    "solvers/options.py",
    "solvers/program.py",
    "solvers/qp",
    "solvers/run.py",
    "solvers/sqp",
    "transcription/plan.py",
)
# What an engine may know of this package, so that it can contradict the rest of it.
ENGINE = {"arrays", "contact", "errors", "robots", "simulation"}


def own_name(name: str) -> str:
    """Module that defines a name of the package itself."""
    return f"impactopt.{impactopt._EXPORTS.get(name, name)}"


@cache
def nodes(file: Path) -> list[ast.AST]:
    """Nodes of a file that import or call."""
    kinds = (ast.Import, ast.ImportFrom, ast.Call)
    return [node for node in ast.walk(ast.parse(file.read_text("utf-8"))) if isinstance(node, kinds)]


def imports(file: Path) -> list[str]:
    """Absolute names of the modules that a file imports, lazily too."""
    inside, found = ("impactopt", *file.relative_to(PACKAGE).parts[:-1]), list[str]()
    for node in nodes(file):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = inside[: len(inside) - node.level + 1] if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            # `from impactopt import sweep` names a module, or something of the package's own
            found += [own_name(alias.name) for alias in node.names] if module == "impactopt" else [module]
        elif isinstance(node, ast.Call):
            # both import_module(...) and importlib.import_module(...)
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name == "import_module":
                found += [str(a.value) for a in node.args if isinstance(a, ast.Constant)]
    return found


def room(file: Path) -> str:
    """The module or folder of the package that a file belongs to."""
    return file.relative_to(PACKAGE).with_suffix("").parts[0]


def rooms_imported(file: Path) -> set[str]:
    parts = [name.split(".") for name in imports(file) if name.split(".")[0] == "impactopt"]
    return {p[1] if len(p) > 1 and p[1] in ROOMS else "__init__" for p in parts}


FILES = sorted(PACKAGE.rglob("*.py"))
ROOMS = {room(file) for file in FILES}


def modules_imported(file: Path) -> set[str]:
    """Modules of the package that a file imports: in functions, for types alone, by its own names too."""
    found = set[str]()
    for node in nodes(file):
        if isinstance(node, ast.ImportFrom) and node.module == "impactopt":
            found |= {own_name(alias.name) for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            # a name of a package is a module in it, or the package's own
            found |= {name if name in MODULES else node.module for name in names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & set(MODULES)


# packages too, but for the one of all, which imports its names when they are used
MODULES = {
    ".".join(("impactopt", *file.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): file
    for file in FILES
    if file != PACKAGE / "__init__.py"
}
