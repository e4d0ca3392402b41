"""`python -m oracle RESULT`: is a saved result right, by a second program? Exit code: 0 yes, 1 no."""

from __future__ import annotations

import sys
from pathlib import Path

from impactopt.files.record import load_record
from impactopt.files.replay import problem_of
from oracle.verdict import verify_record


def main() -> int:
    path = Path(sys.argv[1])
    record = load_record(path)
    verdict = verify_record(problem_of(record, path), record.arrays, record.summary)
    kkt = "unknown" if verdict.kkt is None else f"{verdict.kkt:.1e}"
    print(f"oracle: max. violation {verdict.max_violation:.1e}, KKT residual {kkt}; {verdict.reason or 'ok'}")
    return 0 if verdict.ok else 1


if __name__ == "__main__":
    sys.exit(main())
