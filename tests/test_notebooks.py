"""Notebooks: no outputs in git, code that compiles, and names what there is; `make notebooks` runs them."""

from __future__ import annotations

import ast
import importlib
import json
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def cells(file: Path, kind: str) -> list[str]:
    content = json.loads(file.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in content["cells"] if cell["cell_type"] == kind]


def trees(file: Path) -> list[ast.Module]:
    return [
        ast.parse(source, filename=f"{file.name}, cell {k}") for k, source in enumerate(cells(file, "code"))
    ]


def unknown(tree: ast.AST) -> list[str]:
    """Names that are imported from this package, or taken from it, and are not there."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "impactopt":
            module = importlib.import_module(str(node.module))
            found += [f"{node.module}.{a.name}" for a in node.names if not hasattr(module, a.name)]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "impactopt":
                    importlib.import_module(alias.name)
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "impactopt":
            found += (
                [] if hasattr(importlib.import_module("impactopt"), node.attr) else [f"impactopt.{node.attr}"]
            )
    return found


def test_there_are_ten_in_order() -> None:
    assert sorted(int(file.name.split("_")[0]) for file in NOTEBOOKS) == [*range(1, 11)]


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_outputs_are_stripped(file: Path) -> None:
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    for cell in content["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None, "".join(cell["source"])
            assert cell["metadata"] == {}
    assert len({cell["id"] for cell in content["cells"]}) == len(content["cells"])
    assert content["nbformat"] == 4


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_code_compiles_and_names_what_there_is(file: Path) -> None:
    assert [name for tree in trees(file) for name in unknown(tree)] == []


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
def test_each_tells_a_story_and_checks_it(file: Path) -> None:
    prose, code = cells(file, "markdown"), cells(file, "code")
    assert prose[0].startswith("# ") and len(prose) >= 4
    assert max(len(source.splitlines()) for source in code) <= 40, "cells are short"
    assert sum(isinstance(node, ast.Assert) for tree in trees(file) for node in ast.walk(tree)) >= 2


def test_a_name_that_is_not_there_is_found() -> None:
    assert unknown(ast.parse("from impactopt import SDC, SCD")) == ["impactopt.SCD"]
    assert unknown(ast.parse("import impactopt\nimpactopt.solv(1)")) == ["impactopt.solv"]
