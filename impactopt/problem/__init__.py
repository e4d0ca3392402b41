"""Problem definition: `ImpactProblem` with its scenarios, terms and objectives.

A new term or objective begins here.
"""
