"""Self-contained HTML file: style, scripts and packed arrays. It needs no network."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Mapping
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from impactopt import __version__
from impactopt.files.output import plain

__all__ = ["html_page", "pack", "unpack"]

KINDS = {"<f4": np.float32, "<u2": np.uint16, "<u4": np.uint32, "|u1": np.uint8}  # JavaScript's typed arrays


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


def unpack(packed: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of a packed text."""
    data = zlib.decompress(base64.b64decode(packed))
    start = 4 + int.from_bytes(data[:4], "little")
    header = json.loads(data[4:start])
    arrays = {}
    for name, entry in header.pop("arrays").items():
        kind, shape = np.dtype(entry["kind"]), entry["shape"]
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(data, kind, count, start + entry["place"]).reshape(shape)
    return header, arrays


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


def _asset(name: str) -> str:
    return files("impactopt.report").joinpath("assets").joinpath(name).read_text(encoding="utf-8")
