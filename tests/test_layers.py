"""Imports go one way, from files and robots through problems and programs to plans, checks and commands."""

from __future__ import annotations

import ast
import re
import sys

import pytest
from support.rooms import (
    ENGINE,
    FILES,
    MODULES,
    NUMERIC,
    PACKAGE,
    RANK,
    ROOMS,
    ROOMS_IN_ORDER,
    imports,
    modules_imported,
    room,
    rooms_imported,
)


def test_every_module_has_its_place_in_the_order() -> None:
    assert sorted(ROOMS ^ set(RANK)) == [], "say in ROOMS_IN_ORDER where it belongs"


def test_imports_go_one_way() -> None:
    late = {
        f"{file.relative_to(PACKAGE)} imports {other}"
        for file in FILES
        if (own := room(file)) != "__init__"  # whose names are imported when they are used
        for other in rooms_imported(file) - {own}
        if RANK[other] >= RANK[own]
    }
    assert late == set()


def test_no_import_leads_back() -> None:
    """Neither between rooms nor inside one, nor inside functions, nor for types alone."""
    left = {name: modules_imported(file) - {name} for name, file in MODULES.items()}
    while free := [name for name, needs in left.items() if not needs & set(left)]:
        for name in free:
            del left[name]
    assert not left, f"a circle of imports is among {sorted(left)}"


def test_importing_the_package_imports_nothing_heavy() -> None:
    top = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8")).body
    names = {a.name for n in top if isinstance(n, ast.Import) for a in n.names}
    names |= {str(n.module) for n in top if isinstance(n, ast.ImportFrom)}
    assert names <= {"__future__", "importlib", "typing"}


@pytest.mark.parametrize("name", NUMERIC)
def test_what_follows_the_transcription_is_without_casadi(name: str) -> None:
    files = [file for file in FILES if (PACKAGE / name) in (file, *file.parents)]
    assert files
    for file in files:
        assert "casadi" not in {module.split(".")[0] for module in imports(file)}, file


def test_engines_share_no_code_with_the_planner() -> None:
    engines = sorted((PACKAGE / "simulation").glob("*_engine.py"))
    assert engines
    names = ("result", "target_dynamics", "perturbation", "motors")
    robots = ("mujoco_world", "pinocchio_robot")
    shared = [PACKAGE / "simulation" / f"{name}.py" for name in (*names, *robots)]
    shared += sorted((PACKAGE / "simulation" / "controller").glob("*.py"))
    for file in [*engines, *shared]:
        assert rooms_imported(file) <= ENGINE, file
        assert not [name for name in imports(file) if "rigid_body" in name], file


def test_every_room_says_what_lives_there() -> None:
    entries = [file for file in FILES if file.name == "__init__.py"]
    assert len(entries) >= len(ROOMS_IN_ORDER) - 1  # errors is a file
    assert [str(file) for file in entries if not ast.get_docstring(ast.parse(file.read_text("utf-8")))] == []


# what comes with a declared dependency that cannot do without it, or is called otherwise
BROUGHT_BY = {
    "PIL": "matplotlib",
    "annotated_types": "pydantic",
    "coal": "pin",
    "mcap_ros2": "mcap-ros2-support",
    "websockets": "viser",
    "pinocchio": "pin",
}


def test_what_is_imported_is_declared() -> None:
    text = (PACKAGE.parent / "pyproject.toml").read_text(encoding="utf-8")
    declared = set(re.findall(r'"([A-Za-z][\w-]*)[>=;]', text))
    known = {
        *sys.stdlib_module_names,
        "impactopt",
        *(name.replace("-", "_") for name in declared),
    }
    tops = {name.split(".")[0] for file in FILES for name in imports(file)}
    assert {name for name in tops - known if BROUGHT_BY.get(name) not in declared} == set()
