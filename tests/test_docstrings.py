"""First lines of docstrings: a noun phrase or a verb that names the thing, never a riddle."""

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
QUESTIONS = {"What", "How", "Where", "Which", "Whether", "Who", "Why", "When", "That", "Those"}
HEADLESS = {
    "Of",
    "As",
    "From",
    "To",
    "By",
    "With",
    "At",
    "On",
    "In",
    "For",
    "Until",
    "Between",
    "Without",
    "Under",
}
Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def first_lines() -> Iterator[tuple[str, str]]:
    """First line of each docstring of the package, by file and line."""
    for path in sorted((ROOT / "impactopt").rglob("*.py")):
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, Documented) and (text := ast.get_docstring(node)):
                yield f"{name}:{node.body[0].lineno}", text.splitlines()[0]


def test_first_lines_name_the_thing() -> None:
    lines = dict(first_lines())
    assert len(lines) > 1000
    riddles = {at: line for at, line in lines.items() if line.split()[0].strip(",.:") in QUESTIONS | HEADLESS}
    assert not riddles, riddles
