"""Check that robots of example-robot-data, the arguments, go from file to a true plan, no line edited."""

import sys

from benchmarks.robots import run

report = run(print, names=sys.argv[1:])
true, of = report.numbers["true"], len(report.numbers["rows"])
print(f"{true} of {of} robots are drafted, planned and replayed")
sys.exit(0 if true == of else 1)
