"""Numbers that README and docs repeat are the same everywhere: those of docs/figures.json."""

from __future__ import annotations

import importlib.util
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
KNOWN: dict[str, Any] = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def script() -> Any:
    spec = importlib.util.spec_from_file_location("refresh_figures", ROOT / "docs" / "refresh_figures.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("file", KNOWN["said"])
def test_documents_say_what_was_measured(file: str, script: Any) -> None:
    text = (ROOT / file).read_text(encoding="utf-8")
    sentences = [sentence.format(**script.values(KNOWN)) for sentence in KNOWN["said"][file]]
    assert [sentence for sentence in sentences if sentence not in text] == []


def test_new_measurements_reach_every_sentence(tmp_path: Path, script: Any) -> None:
    for name in (*KNOWN["said"], "docs/figures.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    rows = [{"problem": "punch.toml", "impulse_planned_Ns": 15.614, "iterations": 97}]
    (tmp_path / "truth.json").write_text(json.dumps({"rows": rows}))
    changed = script.refresh(tmp_path, tmp_path)
    assert any(line.startswith("README.md: | `punch` | 15.61 |") for line in changed)
    assert any(line.startswith("docs/benchmarks.md: | `punch` | 97 | 15.61 |") for line in changed)
    again = json.loads((tmp_path / "docs" / "figures.json").read_text())
    assert again["figures"]["punch"]["value"] == 15.61 and again["said"] == KNOWN["said"]
    assert again["figures"]["punch_robust"] == KNOWN["figures"]["punch_robust"], "no bench has measured it"
    assert script.refresh(tmp_path, tmp_path) == []
    readme = tmp_path / "README.md"
    readme.write_text(readme.read_text().replace("| 15.61 |", "| 15.00 |"))
    with pytest.raises(ValueError, match=r"README\.md does not say '\| `punch` \| 15\.61"):
        script.refresh(tmp_path, tmp_path)
