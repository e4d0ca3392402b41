"""The notebooks beside docs/ as pages: the executed copies where `make notebooks` has made them."""

from __future__ import annotations

from pathlib import Path

from sphinx.application import Sphinx
from sphinx.config import Config

ROOT = Path(__file__).resolve().parents[2]
EXECUTED = ROOT / "results" / "notebooks"
PAGES = ROOT / "docs" / "_notebooks"  # made here, not kept in git
# how a notebook in notebooks/ links to a page of docs/, and how a page in docs/_notebooks does
LINK, HERE = "](../docs/", "](../"

HEAD = """# Notebooks

They are in `notebooks/`. `make notebooks` executes them, and these pages then show their outputs.

"""


def gather(app: Sphinx, config: Config) -> None:
    """Copy what is newer, and drop pages whose notebook is gone."""
    found = sorted((ROOT / "notebooks").glob("*.ipynb"), key=lambda file: int(file.name.split("_")[0]))
    sources = {file.name: file for file in found}
    PAGES.mkdir(exist_ok=True)
    for page in PAGES.glob("*.ipynb"):
        if page.name not in sources:
            page.unlink()
    for name, source in sources.items():
        done = EXECUTED / name
        chosen = done if done.is_file() and done.stat().st_mtime >= source.stat().st_mtime else source
        text = chosen.read_text(encoding="utf-8").replace(LINK, HERE)
        page = PAGES / name
        if not page.is_file() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")
    listed = "\n".join(["```{toctree}", "", *(name.removesuffix(".ipynb") for name in sources), "```"])
    (PAGES / "index.md").write_text(HEAD + (listed if sources else "None yet.") + "\n", encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("config-inited", gather)
    return {"parallel_read_safe": True}
