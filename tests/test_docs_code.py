"""Every code block of README and docs does what it says: see docs_blocks.py for what is done with each."""

from __future__ import annotations

import inspect
import shlex
from pathlib import Path
from typing import Any

import pytest
from support.docs_blocks import BASE, PAGES, ROOT, check_line, languages, run_page, whole

import impactopt
from impactopt import ImpactProblem, InputError, Solution, solve

# `text`: what a program prints, pictures of words; braces: directives of the site
KNOWN = ("python", "toml", "sh", "text")
WITH_BLOCKS = [page for page in PAGES if {"python", "toml", "sh"} & set(languages(page))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_block_says_what_it_is(page: Path) -> None:
    assert [tag for tag in languages(page) if tag not in KNOWN and not tag.startswith("{")] == []


def blocks_work(page: Path, directory: Path) -> bool:
    return run_page(page, directory) == sum(tag in KNOWN[:3] for tag in languages(page))


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_BLOCKS, ids=lambda page: str(page.relative_to(ROOT)))
def test_blocks_of_a_page_work(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert blocks_work(page, tmp_path)


def test_blocks_of_the_readme_work_with_a_plan_that_is_there(
    hammered: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its problem is built, and its last lines replay and print the plan of an arm, which takes less long."""

    def solved(problem: ImpactProblem, **options: Any) -> Solution:
        assert isinstance(problem, ImpactProblem)
        inspect.signature(solve).bind(problem, **options)
        return hammered

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(impactopt, "solve", solved)
    assert blocks_work(ROOT / "README.md", tmp_path)


# ---------------------------------------------------------------- the checks can fail
@pytest.mark.parametrize(
    "line",
    [
        "impactopt slove punch",
        "impactopt solve punch --solvr sqp",
        "impactopt solve punch --starts many",
        "impactopt solve",
        "impactopt check no_such_problem",
        "python -m benchmarks trouth",
        "make demmo",
        "make demo ARG='--quiet'",
        "pip install impactopt[robot]",
        "impactopts solve punch",
    ],
)
def test_a_command_that_would_not_work_is_found_out(line: str) -> None:
    with pytest.raises(BaseException) as raised:
        check_line(shlex.split(line))
    assert not isinstance(raised.value, KeyboardInterrupt)


def test_python_that_fails_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text("```python\nx = 1\n```\n\n```python\nassert x == 2\n```\n", encoding="utf-8")
    with pytest.raises(AssertionError):
        run_page(page, tmp_path)


@pytest.mark.parametrize(
    "block",
    [
        "import impactopt\nimpactopt.swep()",
        "from impactopt import Swep",
        "import impactopt\nimpactopt.solve(None, sover=1)",
    ],
)
def test_a_block_that_cannot_run_is_checked_all_the_same(
    block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text(f"<!-- needs SLURM -->\n```python\n{block}\n```\n", encoding="utf-8")
    with pytest.raises((AttributeError, AssertionError)):
        run_page(page, tmp_path)


def test_a_fragment_of_a_problem_file_takes_the_place_of_its_sections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = whole("[target]\nmass_kg = 2.0\n", BASE.read_text(encoding="utf-8"))
    assert text.count("[target]") == 1 and "mass_kg = 2.0" in text and "mass_kg = 5.0" not in text
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text("```toml\n[target]\nmas_kg = 2.0\n```\n", encoding="utf-8")
    with pytest.raises(InputError, match="mas_kg"):
        run_page(page, tmp_path)
