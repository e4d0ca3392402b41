"""Imports go one way, from robots through problems and programs to solutions, checks and commands."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import impactopt

PACKAGE = Path(impactopt.__file__).parent

# Each module or folder may import from those above it; of one line, only from those before it.
LAYERS = (
    ("__init__", "errors", "_folders"),
    ("files", "private_files", "_compiler", "_hashing", "codegen", "_workers"),
    ("_robot_checks", "_robot_parts", "_robot_build", "robot", "_links", "_standin", "_arms", "presets"),
    ("rigid_body",),
    ("stance", "contact"),
    ("collision",),
    ("motion", "cone"),
    ("coordinates", "support", "statics", "reach"),
    (
        "shapes",
        "bodies",
        "terms",
        "extra_terms",
        "objectives",
        "scenario",
        "problem_hash",
        "_problem_checks",
        "problem",
        "plan",
        "between",
    ),
    ("planned_strike",),
    ("nlp",),
    ("program", "sqp", "ipopt_functions", "ipopt"),
    ("validation",),
    ("reference", "cases"),
    ("keeping_apart", "starts", "solution", "baseline", "strike", "planner", "blows", "robustness"),
    ("problem_file", "record_schema", "output", "result_folder", "replay", "sweeps"),
    ("plotting", "result_rows", "report", "screen"),
    ("plain_errors", "bench", "reproduce"),
    (
        "_command_options",
        "_collide_command",
        "_file_commands",
        "_strike_command",
        "_validate_command",
        "_drive_command",
        "_show_command",
        "_sweep_command",
        "cli",
        "__main__",
    ),
)
RANK = {room: rank for rank, room in enumerate(room for layer in LAYERS for room in layer)}
# Below the transcription all is numbers; IPOPT's adapter is the exception, as CasADi's wheel carries IPOPT.
NUMERIC = (
    "bodies",
    "cone",
    "keeping_apart",
    "motion",
    "plan",
    "planned_strike",
    "program",
    "reach",
    "reference",
    "solution",
    "sqp",
    "statics",
    "support",
    "validation",
)
# What an engine may know of this package, so that it can contradict the rest of it.
ENGINE = {"contact", "errors", "robot", "validation"}


def imports(file: Path) -> Iterator[str]:
    """Absolute names of the modules that a file imports, lazily too."""
    inside = ("impactopt", *file.relative_to(PACKAGE).parts[:-1])
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = inside[: len(inside) - node.level + 1] if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            # `from impactopt import cone` names a module, or something of the package's own
            yield from (
                [f"{module}.{alias.name}" for alias in node.names] if module == "impactopt" else [module]
            )


def room(file: Path) -> str:
    """The module or folder of the package that a file belongs to."""
    return file.relative_to(PACKAGE).with_suffix("").parts[0]


def rooms_imported(file: Path) -> set[str]:
    parts = [name.split(".") for name in imports(file) if name.split(".")[0] == "impactopt"]
    return {p[1] if len(p) > 1 and p[1] in ROOMS else "__init__" for p in parts}


FILES = sorted(PACKAGE.rglob("*.py"))
ROOMS = {room(file) for file in FILES}


def test_every_module_has_its_place_in_the_order() -> None:
    assert len(RANK) == sum(len(layer) for layer in LAYERS)
    assert sorted(ROOMS - set(RANK)) == [], "say in LAYERS where it belongs"


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(PACKAGE)))
def test_imports_go_one_way(file: Path) -> None:
    own = room(file)
    if own == "__init__":  # names are imported when they are used
        return
    late = {other for other in rooms_imported(file) - {own} if RANK[other] >= RANK[own]}
    assert late == set()


def test_importing_the_package_imports_nothing_heavy() -> None:
    top = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8")).body
    names = {a.name for n in top if isinstance(n, ast.Import) for a in n.names}
    names |= {str(n.module) for n in top if isinstance(n, ast.ImportFrom)}
    assert names <= {"__future__", "importlib", "typing"}


@pytest.mark.parametrize("name", NUMERIC)
def test_what_follows_the_transcription_is_without_casadi(name: str) -> None:
    for file in FILES:
        if room(file) == name:
            assert "casadi" not in {module.split(".")[0] for module in imports(file)}, file


def test_engines_share_no_code_with_the_planner() -> None:
    engines = sorted((PACKAGE / "validation").glob("*_engine.py"))
    assert engines
    names = ("result", "servo", "soles", "struck", "touch", "conditions")
    shared = [PACKAGE / "validation" / f"{name}.py" for name in names]
    for file in [*engines, *shared, PACKAGE / "validation" / "mujoco_world.py"]:
        assert rooms_imported(file) <= ENGINE, file
