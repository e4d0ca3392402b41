"""Solves an impact problem: initial guesses, mesh refinement, strikes, series of blows, and a baseline."""
