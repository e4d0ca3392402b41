"""Compiled functions and where they are kept. Look here for compilers, caches and keys."""
