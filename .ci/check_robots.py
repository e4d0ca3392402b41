"""Check that robots of example-robot-data, the arguments, go from file to a true plan, no line edited."""

import sys
from pathlib import Path

from benchmarks.robots import run

own = Path("results/ci")  # the bench's own rows took half an hour
report = run(print, names=sys.argv[1:], rows=own / "robots.jsonl", drafts=own)
true, of = report.numbers["true"], len(report.numbers["rows"])
print(f"{true} of {of} robots are drafted, planned and replayed")
sys.exit(0 if true == of else 1)
