"""One way to compile inner loops: once, cached on disk, one thread, without the GIL.

No fast-math (results are compared bit for bit) and no parallel regions (they are not fork-safe;
use processes or threads instead).
"""

import inspect
from collections.abc import Callable
from typing import Any

import numba


def compiled(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Compile `kernel` at its first call; later processes load it from the cache."""
    plain = inspect.unwrap(kernel)  # tests may wrap every function in a shape checker
    try:
        return numba.njit(nogil=True, cache=True)(plain)
    except RuntimeError:  # nowhere to write a cache: compile in every process instead
        return numba.njit(nogil=True)(plain)
