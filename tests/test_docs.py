"""What the documents name exists: code, files, rooms, equations."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from support.rooms import NUMERIC, PACKAGE, ROOMS, ROOMS_IN_ORDER

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
HEADER = ["symbol", "code name", "unit", "equation, source"]
EQUATIONS = 24  # of the paper
CODE = re.compile(r"`([^`]+)`")
SOURCES = sorted(PACKAGE.rglob("*.py"))


def text_of(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def table_rows(text: str) -> Iterator[list[str]]:
    """Cells of every row of the tables with the notation's columns."""
    inside = False
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        if cells == HEADER:
            inside = True
        elif not cells:
            inside = False
        elif inside and set("".join(cells)) - set("-"):
            yield cells


ROWS = list(table_rows(text_of("notation.md")))


@cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


@cache
def names_in(file: Path) -> frozenset[str]:
    """What a file calls something: classes, functions, arguments, variables, attributes, and keys."""
    found: set[str] = set()
    for node in ast.walk(tree(file)):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.add(node.attr)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value) < 40:
            found.add(node.value)
    return frozenset(found)


@cache
def classes() -> dict[str, list[tuple[Path, ast.ClassDef]]]:
    """Every class by name; a section of a problem file may share the name of what it describes."""
    found: dict[str, list[tuple[Path, ast.ClassDef]]] = {}
    for file in SOURCES:
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append((file, node))
    return found


def members(node: ast.ClassDef) -> set[str]:
    """Methods, fields and attributes of a class and of its bases in the package."""
    found: set[str] = set()
    for base in node.bases:
        for _, parent in classes().get(getattr(base, "id", ""), []):
            found |= members(parent)
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef):
            found.add(statement.name)
        elif isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            found.add(statement.target.id)
        elif isinstance(statement, ast.Assign):
            found |= {target.id for target in statement.targets if isinstance(target, ast.Name)}
    for inner in ast.walk(node):
        if isinstance(inner, ast.Attribute) and isinstance(inner.ctx, ast.Store):
            found |= {inner.attr} if getattr(inner.value, "id", "") == "self" else set()
    return found


def missing(name: str, files: list[Path]) -> str:
    """What is wrong with a code name that is said to live in one of these files; "" if nothing is."""
    owner, dot, member = name.partition(".")
    if not dot:
        return "" if any(name in names_in(file) for file in files) else f"no {name!r}"
    if owner not in classes():
        return f"no class {owner!r}"
    here = [node for file, node in classes()[owner] if file in files]
    if not here:
        return f"class {owner!r} is in {[str(file.relative_to(PACKAGE)) for file, _ in classes()[owner]]}"
    return "" if any(member in members(node) for node in here) else f"{owner} has no {member!r}"


def places(text: str) -> Iterator[tuple[str, list[Path]]]:
    """Code names of a text, each with the files that the next parenthesis gives: `a`, `B.c` (`file.py`)."""
    waiting: list[str] = []
    for part in re.split(r"(\((?:`[^`]+\.py`(?:, )?)+\))", text):
        named = CODE.findall(part)
        if part.startswith("(") and named:
            yield from ((name, [PACKAGE / file for file in named]) for name in waiting)
            waiting = []
        else:
            waiting += named
    yield from ((name, []) for name in waiting)


# ---------------------------------------------------------------- notation
def test_the_notation_has_the_symbols_that_matter() -> None:
    symbols = " ".join(row[0] for row in ROWS)
    for symbol in ("H*", "J*k", "K_p", "K_d", "tau_max", "M_g", "I_g", "v_c", "m_a", "ydot", "T1", "ZMP"):
        assert symbol in symbols


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_code_names_of_the_notation_exist_where_it_says(row: list[str]) -> None:
    assert len(row) == len(HEADER), "a cell too many, or too few"
    symbol, code, unit, _ = row
    assert symbol and unit and CODE.search(code)
    for name, files in places(code):
        assert files, f"say in parentheses in which file {name!r} is"
        assert [file for file in files if not file.is_file()] == []
        assert not (wrong := missing(name, files)), wrong


def test_names_outside_the_tables_exist_too() -> None:
    text = "\n".join(line for line in text_of("notation.md").splitlines() if not line.startswith("|"))
    for name in CODE.findall(text):
        if name.endswith((".py", "/")):
            assert (ROOT / name).exists() or (PACKAGE / name).exists(), name
        else:
            assert not (wrong := missing(name, SOURCES)), wrong


def test_equation_numbers_are_the_papers() -> None:
    numbers = [int(n) for row in ROWS for n in re.findall(r"\((\d+)\)", row[3])]
    assert numbers and all(1 <= n <= EQUATIONS for n in numbers)


def test_a_name_that_is_not_there_is_found_out() -> None:
    robot = PACKAGE / "robots/robot.py"
    assert missing("Robot.kp", [robot]) == ""
    assert "has no" in missing("Robot.gain", [robot])
    assert "is in" in missing("SDC.step", [robot])
    assert "no class" in missing("Humanoid.kp", [robot])
    assert "no 'kpp'" in missing("kpp", [robot])
    assert list(places("`a`, `B.c` (`robots/robot.py`, `transcription/plan.py`); `d`")) == [
        ("a", [robot, PACKAGE / "transcription/plan.py"]),
        ("B.c", [robot, PACKAGE / "transcription/plan.py"]),
        ("d", []),
    ]


# ---------------------------------------------------------------- architecture
ARCHITECTURE = text_of("architecture.md")
BLOCKS = ARCHITECTURE.split("```")[1::2]
INLINE = CODE.findall("".join((ARCHITECTURE + text_of("extending.md")).split("```")[::2]))
NAMED = {name for name in INLINE if re.fullmatch(r"[\w/.]+(\.(py|md|toml)|/)", name)}
FOLDERS = ("impactopt/", "tests/", "docs/", "problems/", "pyproject.toml")
TEST_LAYERS = ROOT / "tests" / "support" / "rooms.py"


@pytest.mark.parametrize("name", sorted(NAMED))
def test_files_that_the_architecture_names_exist(name: str) -> None:
    assert ((ROOT if name.startswith(FOLDERS) else PACKAGE) / name).exists()


def test_files_in_the_diagram_exist() -> None:
    named = re.findall(r"[\w/]+\.(?:py|toml)\b|[\w/]+/(?= )", BLOCKS[0])
    assert len(named) > 5
    assert [name for name in named if not ((PACKAGE / name).exists() or (ROOT / name).exists())] == []


def test_code_names_that_the_architecture_uses_exist() -> None:
    # names, also of what a class has, and functions with their arguments
    code = re.compile(r"((?:[A-Z]\w*\.)?\w+)(?:\(.*\))?")
    words = {found[1] for name in INLINE if (found := code.fullmatch(name))} - NAMED
    # modules of the package and of Pinocchio, by their own names
    words = {name for name in words if name.split(".")[0] not in ROOMS | {"pin"}}
    assert len(words) > 20
    tests = [ROOT / name for name in sorted(NAMED) if name.startswith("tests/") and name.endswith(".py")]
    files = [*SOURCES, TEST_LAYERS, *tests]
    assert [wrong for name in sorted(words) if (wrong := missing(name, files))] == []


def test_every_room_is_described() -> None:
    tables = " ".join(line for line in ARCHITECTURE.splitlines() if line.startswith("|"))
    described = {name.rstrip("/").removesuffix(".py").split("/")[0] for name in CODE.findall(tables)}
    assert sorted(ROOMS - described - {"__init__"}) == []


def test_the_import_order_is_the_one_that_is_held() -> None:
    section = ARCHITECTURE.split("## Import order")[1].split("\n## ")[0]
    written = [name for name in CODE.findall(section) if "/" not in name]
    assert written == [room for room in ROOMS_IN_ORDER if not room.startswith("__")]


def test_the_numeric_files_named_are_held_to_it() -> None:
    section = ARCHITECTURE.split("## Two worlds")[1].split("\n## ")[0]
    listed = re.search(r"`NUMERIC` \(([^)]*)\)", section)
    assert listed is not None
    named = [name.rstrip("/") for name in CODE.findall(listed[1])]
    assert named and set(named) <= set(NUMERIC)


@pytest.mark.parametrize("file", sorted(DOCS.rglob("*.md")), ids=lambda file: str(file.relative_to(DOCS)))
def test_links_between_documents_lead_somewhere(file: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", file.read_text(encoding="utf-8")):
        assert "://" in target or (file.parent / target).exists(), target
