"""Saved results, checked by code of its own: rows, objective and KKT residual by Pinocchio and NumPy alone.

Nothing here imports the program, its compiled functions or a solver. What a problem states is written down a
second time, as plain functions of numbers, and derivatives are differences of these.
"""
