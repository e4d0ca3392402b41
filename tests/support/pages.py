"""What a page carries: header and arrays, as its script unpacks them."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
