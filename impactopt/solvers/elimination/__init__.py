"""Elimination of the variables that equalities determine, for the Newton systems and the reduced QPs."""
