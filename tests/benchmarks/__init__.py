"""Benchmarks: what can be measured of plans and replays, each by one command, `python -m benchmarks NAME`.

* __main__.py    the command line; registry.py: benches, and the paper's tables and figures, by name
* report.py, running.py    what each gives: numbers, tables, pictures; reports shown one after the other
* planning.py    from a problem file to a plan worth replaying
* truth.py, robustness.py, replay.py, zoo.py and the others    one bench a file, each with a function `run`
* pictures/      what only benches draw; figures.py: the figures of the documentation
* paper/         the paper's tables and figures beside ours, `python -m benchmarks.paper NAME`

The modules are found with `tests/` on Python's path, as `make` and pytest have it.
"""
