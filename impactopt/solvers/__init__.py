"""Nonlinear programs and who solves them: the protocol, our own solver (`sqp`) and IPOPT.

They know nothing of robots.
"""
