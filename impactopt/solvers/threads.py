"""The threads of BLAS, which small matrices do not need: a second one only waits, and takes the processor."""

from __future__ import annotations

from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def threads() -> ThreadpoolController:
    """Controller of the loaded libraries' thread pools; cached, as finding them takes as long as a QP."""
    return ThreadpoolController()
