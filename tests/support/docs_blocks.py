"""The code blocks of README and docs: Python is run, problem files are read, commands are checked."""

from __future__ import annotations

import ast
import contextlib
import importlib
import inspect
import io
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from importlib.metadata import distribution
from itertools import pairwise
from pathlib import Path
from typing import Any

from sybil import Example, Sybil
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown import CodeBlockParser
from typer.main import get_command

import impactopt
from impactopt.cli.app import app

ROOT = Path(impactopt.__file__).resolve().parents[1]
PAGES = sorted(
    [ROOT / "README.md", *(page for page in (ROOT / "docs").rglob("*.md") if "_notebooks" not in page.parts)]
)
BASE = ROOT / "problems" / "punch_standin.toml"  # what fragments of problem files are parts of
ROBOTS = "cmeel.prefix/share/example-robot-data/robots"
QUICK = (
    "check",
    "new",
    "problems",
    "robots",
)  # commands that are run; of the others it is checked that they exist
HEADER = re.compile(r"^\[{1,2}[^\]]+\]{1,2}", re.MULTILINE)
NEEDS = re.compile(r"<!-- needs [^>]+ -->\s*$")  # before a block that no test can run
OURS = re.compile(r"impactopt\.(\w+)")
COMMENT = re.compile(r"\s+#.*$")
ELSEWHERE = {
    "cd",
    "cp",
    "dask",
    "export",
    "git",
    "open",
    "python",
    "python3",
    "ros2",
    "source",
    "uv",
}  # what the reader's machine has


# ------------------------------------------------------------ Python
def run_python(example: Example) -> None:
    """Run a block; after a comment `<!-- needs SOMETHING -->` check only that what it uses of ours exists."""
    if NEEDS.search(example.document.text[: example.start]):
        check_python(str(example.parsed))
    else:
        PythonEvaluator()(example)


def check_python(text: str) -> None:
    """Names of the package, and the keywords that its functions are called with, exist."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom) and node.module == "impactopt":
            for alias in node.names:
                getattr(impactopt, alias.name)
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "impactopt":
            getattr(impactopt, node.attr)
        elif isinstance(node, ast.Call) and (named := OURS.fullmatch(ast.unparse(node.func))):
            known = set(inspect.signature(getattr(impactopt, named[1])).parameters)
            assert {keyword.arg for keyword in node.keywords} <= known, f"{named[1]} takes {known}"


# ------------------------------------------------------------ problem files
def sections(text: str) -> list[str]:
    """A TOML text, cut before every header."""
    cuts = [0, *(found.start() for found in HEADER.finditer(text)), len(text)]
    return [text[a:b] for a, b in pairwise(cuts)]


def header(section: str) -> str:
    found = HEADER.match(section)
    return found[0] if found else ""


def whole(fragment: str, base: str) -> str:
    """The base with a fragment's sections in place of its own; a robot's section in place of its name."""
    given = {header(section) for section in sections(fragment)}
    kept = [section for section in sections(base) if header(section) not in given - {""}]
    if any(name.startswith(("[robot]", "[robot.")) for name in given):
        kept = [re.sub(r"(?m)^robot = .*\n", "", section) for section in kept]
    return "".join(kept) + "\n" + fragment


def read_toml(example: Example) -> None:
    """A whole file, under the name that its first line gives, or a fragment of the page's last whole one."""
    from impactopt.files.problem_file import read_problem_file
    from impactopt.sweeps import read_sweep_file

    text = str(example.parsed)
    named = re.match(r"# (\S+\.toml)\b", text)
    if "[sweep]" in text:
        path = Path(named[1] if named else "sweep.toml")
        path.write_text(text, encoding="utf-8")
        read_sweep_file(path)
        return
    if "[problem]" not in text:
        text = whole(text, example.namespace.get("_toml") or BASE.read_text(encoding="utf-8"))
    else:
        example.namespace["_toml"] = text
    path = Path(named[1] if named else "block.toml")
    path.write_text(text, encoding="utf-8")
    read_problem_file(path).build()


# ------------------------------------------------------------ commands
def commands(text: str) -> Iterator[list[str]]:
    """The words of every command line of a block, without comments and prompts."""
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(COMMENT.sub("", line.removeprefix("$ ")))
        while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
            words = words[1:]
        if words and not words[0].startswith("#"):
            yield words


def named(program: Any, name: str, words: list[str]) -> tuple[Any, str, list[str]]:
    """The command that the first words name, its whole name, and the words after it."""
    command: Any = get_command(program)
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        assert words[0] in command.commands, f"{name} has no command {words[0]!r}"
        command, name, words = command.commands[words[0]], f"{name} {words[0]}", words[1:]
    return command, name, words


def check_impactopt(words: list[str]) -> None:
    """An `impactopt` command's name, arguments and options exist, of the right kind; quick ones run."""
    words, written = (words[:-2], words[-1]) if words[-2:-1] == [">"] else (words, None)
    command, name, rest = named(app, "impactopt", words)
    if words[:1] and words[0] in QUICK:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            code = command.main(rest, prog_name=name, standalone_mode=False)
        assert not code, f"{name} {' '.join(rest)}: exit code {code}"
        if written is not None:
            Path(written).write_text(printed.getvalue(), encoding="utf-8")
    elif not {"--help", "--version"} & set(rest):
        command.make_context(name, list(rest))


def check_benchmark(module: str, words: list[str]) -> None:
    """A command of `tests/benchmarks/`, by its arguments and options."""
    file = module if module.endswith(".figures") else f"{module}.__main__"
    command, name, rest = named(importlib.import_module(file).app, f"python -m {module}", words)
    if "--help" not in rest:
        command.make_context(name, list(rest))


def check_make(words: list[str]) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in words:
        if "=" in target:
            assert re.search(rf"^{target.split('=')[0]}\s*\??=", makefile, re.MULTILINE), target
        else:
            assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE), f"no target {target!r}"


def check_pip(words: list[str]) -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for extra in re.findall(r"\[([^\]]+)\]", " ".join(words)):
        for name in extra.split(","):
            assert re.search(rf"^{name} = \[", project, re.MULTILINE), f"no extra {name!r}"


def check_line(words: list[str]) -> None:
    """One command line; AssertionError, or what the command itself raises, if it would not work."""
    program = Path(words[0]).name
    if program == "impactopt":
        check_impactopt(words[1:])
    elif words[1:2] == ["-m"] and words[2].partition(".")[0] == "benchmarks":
        check_benchmark(words[2], words[3:])
    elif program == "make":
        check_make(words[1:])
    elif program == "pip":
        check_pip(words[1:])
    elif words[0].startswith("."):
        assert (ROOT / words[0]).exists() or words[0].startswith(".venv/bin/"), words[0]
    else:
        assert program in ELSEWHERE, f"{program!r} is none of the project's commands"


def run_shell(example: Example) -> None:
    for words in commands(str(example.parsed)):
        check_line(words)


# ------------------------------------------------------------ pages
SYBIL = Sybil(
    parsers=[
        CodeBlockParser(language="python", evaluator=run_python),
        CodeBlockParser(language="toml", evaluator=read_toml),
        CodeBlockParser(language="sh", evaluator=run_shell),
    ]
)
FENCE = re.compile(r"^\s*(```+)(.*?)$", re.MULTILINE)


def languages(page: Path) -> list[str]:
    """What each fenced block of a page is tagged with."""
    opening: str | None = None
    found = []
    for ticks, tag in FENCE.findall(page.read_text(encoding="utf-8")):
        if opening is None:
            opening, _ = ticks, found.append(tag.strip())
        elif ticks == opening:
            opening = None
    return found


def run_page(page: Path, directory: Path) -> int:
    """Run all blocks of a page, one after the other, in a directory; how many there were.

    The reader's own robot is there: TALOS's URDF as my_robot.urdf.
    """
    os.chdir(directory)
    robots = Path(
        str(distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data"))
    )
    shutil.copy(robots / "robots/talos_data/robots/talos_reduced.urdf", "my_robot.urdf")
    count = 0
    document = SYBIL.parse(page)
    document.namespace["__name__"] = "__main__"  # it is what the reader runs
    for example in document.examples():
        example.evaluate()
        count += 1
    return count
