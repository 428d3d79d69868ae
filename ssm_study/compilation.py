"""Just-in-time compilation of numeric loops by Numba. The machine code is kept on disk where that
is possible."""

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import njit


class UncachedCodeWarning(UserWarning):
    """Warning that the machine code compiled by Numba cannot be stored on disk, so that every
    process compiles its own."""


def compile_with_numba(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator that compiles a numeric function with Numba when it is first called.

    The code is kept beside the source, in the user's cache, or in `NUMBA_CACHE_DIR`; without a
    folder that may be written to (a read-only installation, no home) it is compiled in each
    process, which is said once. Division is that of C: no checks inside the loops.
    """
    try:
        compiled: Callable[..., Any] = njit(cache=True, error_model="numpy")(function)
    except RuntimeError as error:  # numba's, for no place to write to
        if "cannot cache" not in str(error):
            raise
        _warn_of_missing_cache()
        compiled = njit(error_model="numpy")(function)
    return compiled


@cache
def _warn_of_missing_cache() -> None:
    """Warn, once in each process, that machine code compiled by Numba cannot be stored on disk."""
    problem = "compiled code cannot be kept, so each process compiles for some seconds"
    remedy = "set NUMBA_CACHE_DIR to a folder that may be written to"
    warnings.warn(f"{problem}; {remedy}", UncachedCodeWarning, stacklevel=3)
