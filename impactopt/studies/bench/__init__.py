"""Benchmarks: what can be measured of plans and replays, each by one command, `impactopt bench NAME`.

* registry.py    the benches by name
* report.py      what a bench gives: numbers, tables, pictures; how they are kept
* planning.py    from a problem file to a plan worth replaying
* command.py     the command line
* truth.py, robustness.py, replay.py, zoo.py and the others    one bench a file, each with a function `run`
"""
