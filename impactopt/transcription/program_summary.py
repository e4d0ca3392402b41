"""Summary of a saved result's program: names of variables and constraints, and additions to the mesh."""

from __future__ import annotations

import json
from itertools import groupby
from typing import Any

from impactopt.transcription.clearance import SeparationBlock
from impactopt.transcription.collision import Collision
from impactopt.transcription.transcription import Transcription

__all__ = ["statement_of"]


def statement_of(t: Transcription) -> str:
    """JSON summary of a program, for a reader that knows nothing of this package.

    `groups`: name, count and size of the variables, in their order. `rows`: term, place and the number of a
    list of `components`. `more`: nodes beside those of the mesh. `elements`, `guarded`, `shares`,
    `shortest`: of the contact, its least durations [s] by collision. `apart`: rows between bodies.
    """
    lists: dict[tuple[str, ...], int] = {}
    rows = []
    for (term, place), found in groupby(t.rows.origins, lambda row: (row.term, row.place.name)):
        components = tuple(row.component for row in found)
        rows.append([term, place, lists.setdefault(components, len(lists))])
    collisions = [c for c in t.hit.collisions if isinstance(c, Collision)]
    # directions as they are now: begun at those of a first round, other distances than the least are found
    ways = [way.tolist() for block in t.blocks if isinstance(block, SeparationBlock) for way in block.of.ways]
    held: list[dict[str, Any]] = [
        {**row._asdict(), **kept._asdict(), "way": way}
        for (row, kept), way in zip(t.apart_rows.items(), ways, strict=True)
    ]
    return json.dumps(
        {
            "groups": [[g.name, g.count, g.size] for g in t.layout.groups.values()],
            "rows": rows,
            "components": list(lists),
            "more": [list(t.nodes.swing), list(t.nodes.follow)],
            "elements": t.hit.elements if collisions else [],
            "guarded": t.hit.guarded,
            "shares": list(t.hit.shares),
            "shortest": [c.shortest for c in collisions],
            "apart": held,
        }
    )
