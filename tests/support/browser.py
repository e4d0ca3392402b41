"""Chromium without a window: opens pages, works their controls, says what they logged and asked for.

The Chromium is Qt's: `pip install 'impactopt[browser]'` brings it, as no other package has one in its wheel
that can be driven. It runs in a process of its own, in software, so that no display and no GPU is needed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

FLAGS = (
    "--no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"
)
DARK = "--blink-settings=preferredColorScheme=0"  # who uses it prefers dark pages
WITHOUT_3D = "--disable-3d-apis"
READY = (
    "document.documentElement?.dataset.ready !== undefined || document.getElementById('trouble')?.innerText"
)
PATIENCE = 60.0  # [s] for one page to be ready


@dataclass(frozen=True, kw_only=True)
class Job:
    """A page to open at a width [pixels]; then each script, an expression, is run, and its value kept.

    page : a file, or an address.
    """

    page: Path | str
    width: int = 1280
    scripts: tuple[str, ...] = ()
    picture: Path | None = None  # a file to put one into
    ready: str = READY  # an expression that says that the page can be looked at
    done: str = ""  # one that says that the scripts have had their effect


@dataclass(frozen=True, kw_only=True)
class Visit:
    """What came of a job: lines of the console, addresses that were asked for, and the scripts' values."""

    console: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)


def visit(*jobs: Job, flags: str = "") -> list[Visit]:
    """The jobs, one after the other, in one browser; flags : DARK, WITHOUT_3D."""
    given = json.dumps(
        [dataclasses.asdict(job) for job in jobs], default=lambda path: path.resolve().as_uri()
    )
    environment = {
        **os.environ,
        "QT_QPA_PLATFORM": "offscreen",
        "QTWEBENGINE_CHROMIUM_FLAGS": f"{FLAGS} {flags}",
    }
    environment |= {"QTWEBENGINE_DISABLE_SANDBOX": "1"}
    done = subprocess.run(
        [sys.executable, __file__],
        input=given,
        capture_output=True,
        text=True,
        env=environment,
        timeout=120 + PATIENCE * len(jobs),
        check=False,
    )
    assert done.returncode == 0, f"no browser (pip install 'impactopt[browser]'):\n{done.stderr[-3000:]}"
    return [Visit(**answer) for answer in json.loads(done.stdout)]


def _main() -> None:
    from PyQt6.QtCore import QEventLoop, QTimer, QUrl
    from PyQt6.QtWebEngineCore import QWebEnginePage, QWebEngineProfile, QWebEngineUrlRequestInterceptor
    from PyQt6.QtWebEngineWidgets import QWebEngineView
    from PyQt6.QtWidgets import QApplication

    class Requests(QWebEngineUrlRequestInterceptor):
        def __init__(self, urls: list[str]) -> None:
            super().__init__()
            self.urls = urls

        def interceptRequest(self, info: Any) -> None:
            self.urls.append(info.requestUrl().toString()[:200])

    class Page(QWebEnginePage):
        lines: list[str]

        def javaScriptConsoleMessage(self, level: Any, message: str, line: int, source: str) -> None:
            self.lines.append(f"{level.name}: {message} (line {line})")

    def wait(milliseconds: int) -> None:
        loop = QEventLoop()
        QTimer.singleShot(milliseconds, loop.quit)
        loop.exec()

    def value(page: Page, script: str) -> Any:
        found: list[Any] = []
        page.runJavaScript(f"JSON.stringify((() => {{ return {script}; }})() ?? null)", found.append)
        end = time.monotonic() + PATIENCE
        while not found and time.monotonic() < end:
            wait(10)
        return json.loads(found[0]) if found and found[0] else None

    application = QApplication(sys.argv[:1])
    answers = []
    for job in json.loads(sys.stdin.read()):
        answer = Visit()
        profile = QWebEngineProfile()
        requests = Requests(answer.requests)
        profile.setUrlRequestInterceptor(requests)
        page = Page(profile)
        page.lines = answer.console
        view = QWebEngineView()
        view.setPage(page)
        view.resize(job["width"], 900)
        view.show()
        page.load(QUrl(job["page"]))
        end = time.monotonic() + PATIENCE
        while not value(page, job["ready"]) and time.monotonic() < end:
            wait(50)
        wait(100)
        for script in job["scripts"]:
            answer.values.append(value(page, script))
            wait(50)
        end = time.monotonic() + PATIENCE
        while job["done"] and not value(page, job["done"]) and time.monotonic() < end:
            wait(50)
        if job["picture"]:
            wait(300)
            view.grab().save(QUrl(job["picture"]).toLocalFile())
        answers.append(dataclasses.asdict(answer))
        view.close()
        view.setPage(None)
        del view, page, profile
    sys.stdout.write(json.dumps(answers))
    sys.stdout.flush()
    del application
    os._exit(0)  # Qt's own end may wait for its processes


if __name__ == "__main__":
    _main()
