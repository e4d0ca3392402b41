"""Benchmarks: what can be measured of plans and replays, each by one command, `impactopt bench NAME`.

* planning.py    from a problem file to a plan worth replaying
* truth.py, robustness.py, replay.py, zoo.py and the others    one bench a file, each with a function `run`
"""
