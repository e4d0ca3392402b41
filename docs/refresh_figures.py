"""New values for the numbers that README and docs repeat: `python docs/refresh_figures.py results/bench`.

Reads what `python -m benchmarks NAME --out results/bench` wrote, and puts each value into docs/figures.json
and into all sentences that are listed there. What no bench in the directory has measured stays as it is.
`tests/test_docs_figures.py` holds the documents to the file.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FILE = Path("docs") / "figures.json"


def values(known: dict[str, Any]) -> dict[str, float]:
    """By name."""
    return {name: figure["value"] for name, figure in known["figures"].items()}


def measured(figure: dict[str, Any], results: Path) -> float | None:
    """The value in a bench's numbers; None without them, or where they have no such row."""
    file = results / f"{figure['bench']}.json"
    if not file.exists():
        return None
    rows = json.loads(file.read_text(encoding="utf-8"))["rows"]
    found = [row.get(figure["key"]) for row in rows if figure["row"].items() <= row.items()]
    number = next((x for x in found if x is not None), None)
    return None if number is None else round(figure.get("times", 1) * number, 2) + 0.0  # no -0


def refresh(results: Path, root: Path = ROOT) -> list[str]:
    """Put new values in; gives the sentences that have changed.

    ValueError : a document does not say what the file has, so that nobody knows what to change.
    """
    known = json.loads((root / FILE).read_text(encoding="utf-8"))
    old = values(known)
    for figure in known["figures"].values():
        new = measured(figure, results)
        figure["value"] = figure["value"] if new is None else new
    texts, changed = {}, []
    for name, sentences in known["said"].items():
        texts[name] = (root / name).read_text(encoding="utf-8")
        for sentence in sentences:
            before, after = sentence.format(**old), sentence.format(**values(known))
            if before not in texts[name]:
                raise ValueError(f"{name} does not say {before!r}; mend it, or its line in {FILE}")
            if before != after:
                texts[name] = texts[name].replace(before, after)
                changed.append(f"{name}: {after}")
    for name, text in texts.items():
        (root / name).write_text(text, encoding="utf-8")
    (root / FILE).write_text(_written(known), encoding="utf-8")
    return changed


def _written(known: dict[str, Any]) -> str:
    """As JSON with a line for each figure."""
    text = json.dumps({**known, "figures": {}}, indent=2, ensure_ascii=False)
    rows = [f"    {json.dumps(name)}: {json.dumps(figure)}" for name, figure in known["figures"].items()]
    return text.replace('"figures": {}', '"figures": {\n' + ",\n".join(rows) + "\n  }", 1) + "\n"


if __name__ == "__main__":
    print("\n".join(refresh(Path(sys.argv[1]))) or "nothing has changed")
