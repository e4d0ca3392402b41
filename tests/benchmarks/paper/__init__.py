"""The paper's tables and figures beside ours, each by one command, `python -m benchmarks.paper NAME`.

* paper.py       what the paper prints
* costs.py       its formulas of computation cost; timing.py, trees.py: our own implementations, measured
* motions.py     the nine motions through every model of the hierarchy
* table1.py, table2.py, table3.py, fig3.py, fig4.py, fig7.py    one a file, each with a function `run`
"""
