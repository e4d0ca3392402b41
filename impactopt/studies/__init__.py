"""Studies of the package itself: `impactopt bench` and `impactopt reproduce`, on the public API.

* registry.py           benches, and the paper's tables and figures, by name
* report.py             what each gives: numbers, tables, pictures; how tables are made and all is kept
* running.py            reports shown one after the other
* bench_command.py, reproduce_command.py, figures.py    the command lines
"""
