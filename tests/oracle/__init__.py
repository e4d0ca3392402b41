"""The oracle: a result's program written down a second time, by Pinocchio and NumPy alone.

`python -m oracle RESULT` judges a saved one. Nothing here imports the program, its compiled functions or a
solver. What a problem states is a set of plain functions of numbers, and derivatives are differences of
these. It judges plans that tests and CI make.
"""
