"""A saved result, checked: the record and the summary beside it, by `impactopt.verification`."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

from impactopt.codegen.files import read_plain
from impactopt.errors import InputError
from impactopt.files.output import LARGEST, NUMBERS, SUMMARY, load_record
from impactopt.files.replay import problem_of
from impactopt.verification.verdict import Verdict, verify_record

__all__ = ["verify"]


def verify(result: str | os.PathLike[str], *, problem_file: str | os.PathLike[str] | None = None) -> Verdict:
    """Compute every constraint, the objective and the KKT residual of a result anew, from its files alone.

    result : a directory that `impactopt solve` wrote, or its `solution.npz`.
    problem_file : instead of the record's own text, such as when its URDF has moved.

    Raises
    ------
    InputError : there is no record, or it does not say what its program was.
    """
    record, path = load_record(result), Path(result)
    problem = problem_of(record, path, problem_file, None)
    verdict = verify_record(problem, record.arrays, record.summary)
    beside = (path.parent if path.name == NUMBERS and not path.is_dir() else path) / SUMMARY
    if not beside.exists() or _read(beside) == record.summary:
        return verdict
    reason = f"{SUMMARY} is not the summary in {NUMBERS}"
    return dataclasses.replace(
        verdict,
        ok=False,
        reason="; ".join(filter(None, [reason, verdict.reason])),
        rows={**verdict.rows, "summary": (float("inf"), SUMMARY)},
        max_violation=float("inf"),
    )


def _read(path: Path) -> Any:
    try:
        return json.loads(read_plain(path, LARGEST))
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged ({error}); solve again with `impactopt solve`") from error
