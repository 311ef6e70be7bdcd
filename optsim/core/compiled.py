"""Loops that numba compiles when they first run.

Importing numba and making it ready takes longer than a small camera's frame. So loops are only marked here. A
command that runs none of them, such as ``optsim explain``, never imports numba.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from functools import update_wrapper
from pathlib import Path
from threading import Lock
from typing import Any, Generic, ParamSpec, TypeVar

from optsim.core.cache import default_folder
from optsim.core.errors import ConfigError

P = ParamSpec("P")
R = TypeVar("R")
_one_at_a_time = Lock()
# Below this many numbers, whole-array numpy finishes before a compiled loop could be loaded: `optsim explain
# demo` takes 2.0 s of CPU time so, 2.5 s with loops, and 18 s when they are compiled first.
FEW = 100_000


def cache_folder() -> Path:
    """Folder that numba keeps compiled loops in: the package's own, else one in ``$OPTSIM_CACHE``.

    Raises
    ------
    ConfigError
        When the package can't be written and this user has no cache.
    """
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    package = Path(__file__).parents[1]
    return package if os.access(package, os.W_OK) else default_folder() / "numba"


# Numba reads this when it is imported; without a cache it says so itself.
with suppress(ConfigError):
    if cache_folder() != Path(__file__).parents[1]:
        os.environ["NUMBA_CACHE_DIR"] = str(cache_folder())


class Compiled(Generic[P, R]):
    """A function in the subset of Python that numba compiles; compiled loops may call it, too."""

    def __init__(self, function: Callable[P, R], options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._dispatcher: Any = None

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run it."""
        return self.dispatcher()(*args, **kwargs)

    def dispatcher(self) -> Any:
        """Numba's own form of the function."""
        if self._dispatcher is None:
            import numba
            from numba.extending import typeof_impl

            with _one_at_a_time:
                # Tells numba the type of this object inside another compiled loop.
                if Compiled not in typeof_impl.registry:
                    typeof_impl.register(Compiled, _numba_type)
                if self._dispatcher is None:
                    # With Python's error model a division might raise, and its loop is not vectorised.
                    jit = numba.njit(nogil=True, cache=True, error_model="numpy", **self._options)
                    self._dispatcher = jit(self._function)
        return self._dispatcher


def _numba_type(loop: Compiled[..., Any], _: object) -> object:
    from numba import types

    return types.Dispatcher(loop.dispatcher())


def compiled(*, makes_arrays: bool = True, **options: Any) -> Callable[[Callable[P, R]], Compiled[P, R]]:
    """Mark a loop that numba compiles at its first call; it releases Python's lock while it runs.

    Parameters
    ----------
    makes_arrays : bool
        Whether the loop allocates arrays. If not, numba need not count references to its arguments. For a
        tuple of arrays that saves one atomic count an array and call.
    **options
        Options of ``numba.njit``, such as ``fastmath``.
    """
    return lambda function: Compiled(function, options if makes_arrays else {**options, "_nrt": False})
