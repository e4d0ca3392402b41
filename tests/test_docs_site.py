"""The documentation builds without a warning, asks nothing of the internet, and has what it promises."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from support.browser import Job, visit

import impactopt

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LOADS = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src", "video": "src"}
ELSEWHERE = re.compile(r"(\w+:)?//")


class Page(HTMLParser):
    """What a page loads, and the names that links can lead to."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.formulas = 0
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        known = dict(attrs)
        self.formulas += tag == "math"
        self.anchors.add(known.get("id") or "")
        if where := known.get(LOADS.get(tag, "")):
            self.loads.append(where)
        if tag == "a" and (leads := known.get("href")):
            self.links.append(leads)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site as `make docs` builds it, but without garbage collection, a quarter of its time; warnings are
    errors, as a link that leads nowhere is.
    """
    out = tmp_path_factory.mktemp("site")
    build = "import gc, sys; gc.disable(); from sphinx.cmd.build import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", build, "-W", "--keep-going", "-q", str(DOCS), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=out)
    assert done.returncode == 0, done.stderr[-4000:]
    return out


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {file: Page(file) for file in sorted(site.rglob("*.html"))}


@pytest.mark.slow
def test_every_public_name_is_in_the_reference(pages: dict[Path, Page]) -> None:
    described = set().union(*(page.anchors for page in pages.values()))
    public = {f"impactopt.{name}" for name in impactopt.__all__ if name != "__version__"}
    assert public - described == set()


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    assert sum(len(page.loads) for page in pages.values()) > 20
    asked = [(file.name, url) for file, page in pages.items() for url in page.loads if ELSEWHERE.match(url)]
    assert asked == []
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        assert re.findall(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//[^)]*", text) == [], style.name


@pytest.mark.slow
def test_links_within_the_site_lead_somewhere(site: Path, pages: dict[Path, Page]) -> None:
    broken = []
    for file, page in pages.items():
        for link in {link for link in page.links if not ELSEWHERE.match(link)} - {""}:
            name, _, anchor = link.partition("#")
            if link.startswith("mailto:"):
                continue
            target = Path(os.path.normpath(file.parent / name)) if name else file
            known = pages.get(target)
            if (known is None and not target.is_file()) or (
                anchor and known is not None and anchor not in known.anchors
            ):
                broken.append(f"{file.relative_to(site)}: {link}")
    assert broken == []


@pytest.mark.slow
def test_formulas_are_drawn_by_the_browser_itself(site: Path, pages: dict[Path, Page]) -> None:
    assert sum(page.formulas for page in pages.values()) > 30
    left = [file.name for file in pages if re.search(r"\\frac|\\mathsf|\\begin\{", file.read_text("utf-8"))]
    assert left == []


@pytest.mark.slow
def test_the_search_works_from_disk_and_asks_nobody(site: Path) -> None:
    go = site / "go.html"
    go.write_text("<script>location = 'search.html?q=nail'</script>", encoding="utf-8")
    found = "[...document.querySelectorAll('#search-results li a')].map((a) => a.getAttribute('href'))"
    (visited,) = visit(Job(page=go, ready=f"{found}.length > 5", scripts=(found,)))
    assert any("api/contact.html" in link for link in visited.values[0])
    assert [url for url in visited.requests if not url.startswith("file:")] == []
    assert visited.console == []


def test_a_notebook_is_shown_as_executed_until_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = importlib.util.spec_from_file_location("gathering", DOCS / "_ext" / "notebooks.py")
    assert spec is not None and spec.loader is not None
    gathering = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gathering)
    source, executed = tmp_path / "notebooks" / "1_one.ipynb", tmp_path / "results" / "1_one.ipynb"
    pages = tmp_path / "pages"
    for name, value in (("ROOT", tmp_path), ("EXECUTED", executed.parent), ("PAGES", pages)):
        monkeypatch.setattr(gathering, name, value)
    for file, text in ((source, "stripped"), (executed, "executed [see](../docs/limits.md)")):
        file.parent.mkdir()
        file.write_text(text, encoding="utf-8")
    os.utime(source, (0, 0))
    gathering.gather(None, None)
    assert (pages / "1_one.ipynb").read_text(encoding="utf-8") == "executed [see](../limits.md)"
    os.utime(source)
    os.utime(executed, (0, 0))
    gathering.gather(None, None)
    assert (pages / "1_one.ipynb").read_text(encoding="utf-8") == "stripped"
