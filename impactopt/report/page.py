"""Self-contained HTML file: style, scripts and packed arrays. It needs no network."""

from __future__ import annotations

import base64
import json
import os
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt import __version__
from impactopt.files.output import check_ending, write_file
from impactopt.files.record import plain
from impactopt.report.result_rows import Row

KINDS = {"<f4": np.float32, "<u2": np.uint16, "<u4": np.uint32, "|u1": np.uint8}  # JavaScript's typed arrays


@dataclass(frozen=True)
class Page:
    """A page that needs no network.  html : its text."""

    html: str

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the page as one HTML file, into an existing folder.

        Raises
        ------
        InputError : the file cannot be written, or its name does not end with .html.
        """
        path = Path(path)
        check_ending("a page is HTML", path, ".html", ".htm")
        write_file(path, lambda file: file.write(self.html.encode()))
        return path


def pack(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Base64 of a zlib stream: length of the JSON (4 bytes), JSON, and arrays, each aligned to 4 bytes.

    The JSON is the header, and under "arrays" each array's kind, shape and offset (place) after the JSON.
    Arrays of other kinds than KINDS are stored in single precision.
    """
    table: dict[str, Any] = {}
    parts, offset = [], 0
    for name, array in arrays.items():
        stored = array if array.dtype.str in KINDS else array.astype("<f4")
        data = np.ascontiguousarray(stored).tobytes()
        table[name] = {"kind": stored.dtype.str, "shape": stored.shape, "place": offset}
        parts.append(data + bytes(-len(data) % 4))
        offset += len(parts[-1])
    text = json.dumps(plain({**header, "arrays": table}), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return base64.b64encode(
        zlib.compress(len(text).to_bytes(4, "little") + text + b"".join(parts), 9)
    ).decode()


# in this order: each uses those before it
SCRIPTS = ("unpack", "geometry", "view", "player", "charts", "main")


def html_page(
    *, title: str, kind: str, body: str, header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> str:
    """HTML of a page; `body` is HTML, `title` is text; kind: "report", or "alone" for an animation alone."""
    scripts = "\n".join(_asset(f"{name}.js") for name in SCRIPTS)
    given = {
        "generator": f"impactopt {__version__}",
        "title": escape(title),
        "kind": kind,
        "style": _asset("style.css"),
        "body": body,
        "numbers": pack(header, arrays),
        "scripts": scripts,
    }
    page = _asset("page.html")
    # in a single pass, because the inserted texts may contain such marks
    return re.sub(r"\{\{(\w+)\}\}", lambda mark: given[mark.group(1)], page)


def report_html(
    *,
    title: str,
    heading: str,
    about: str,
    parts: Iterable[str],
    header: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> str:
    """HTML of a report's page: heading and a text about it, parts as HTML, and the footer."""
    body = [
        f'<header><h1>{escape(heading)}</h1><span class="sub">{escape(about)}</span>',
        '<button id="theme" aria-label="switch between light and dark">dark</button></header><main>',
        '<div id="trouble"></div>',
        *filter(None, parts),
        "</main><footer><main>Made by impactopt. This file holds all that it shows and needs no network.",
        "</main></footer>",
    ]
    return html_page(title=title, kind="report", body="\n".join(body), header=header, arrays=arrays)


def html_table(
    rows: Sequence[Row], head: Sequence[str] = (), *, kind: str = "", row_attributes: Sequence[str] = ()
) -> str:
    """HTML table; values outside their limits are marked.

    head : titles of all columns, that of the labels first.  kind : CSS class.  row_attributes : of each row.
    """
    titles = "".join(f'<th scope="col">{escape(name)}</th>' if name else "<td></td>" for name in head)
    lines = []
    for k, row in enumerate(rows):
        cells = "".join(
            f"<td>{escape(cell.text)}</td>" if cell.good else f'<td class="bad">! {escape(cell.text)}</td>'
            for cell in row.cells
        )
        attributes = f" {row_attributes[k]}" if row_attributes else ""
        lines.append(f'<tr{attributes}><th scope="row">{escape(row.label)}</th>{cells}</tr>')
    above = f"<thead><tr>{titles}</tr></thead>" if head else ""
    style = f' class="{kind}"' if kind else ""
    return f"<table{style}>{above}<tbody>{''.join(lines)}</tbody></table>"


def _asset(name: str) -> str:
    return files("impactopt.report").joinpath("assets").joinpath(name).read_text(encoding="utf-8")
