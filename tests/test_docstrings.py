"""First lines of docstrings: a noun phrase or a verb that names the thing, never a riddle."""

import ast
import re
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


# words that only this project used, and the field's in their place (CONTRIBUTING.md has the rule)
DIALECT = {
    r"wish(es)?": "request",
    r"mend(s|ed)?": "fix",
    r"judged?": "checked",
    r"newest": "latest",
    r"rattles?": "contact chatter",
    r"handed on": "mapped, warm start",
    r"asked of": "required",
    r"who (asks|watches|calls|hits|looks)": "the caller, the name of the object",
    r"gets? nowhere": "stalls",
    r"in each other": "penetrating",
    r"elastic rows?|rows? on demand|soft rows?": "constraints",
    r"no numbers? in": "NaN",
}


def test_prose_and_names_are_in_the_fields_words() -> None:
    any_of_them = re.compile(rf"\b({'|'.join(DIALECT)})\b", flags=re.IGNORECASE)
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()} ({field})"
        for path in sorted((ROOT / "impactopt").rglob("*"))
        if path.suffix in (".py", ".c", ".h")
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if any_of_them.search(line)
        for word, field in DIALECT.items()
        if re.search(rf"\b({word})\b", line, flags=re.IGNORECASE)
    ]
    assert not found, found
