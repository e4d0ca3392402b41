"""Compiled functions and how files are kept: compilers, caches, keys; writing whole files, private ones.

Look here where a file is damaged or in the wrong place.
"""
