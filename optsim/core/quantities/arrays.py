"""Names of array types, and the one check that every value runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from optsim.core.errors import ValueCheckError

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Words = NDArray[np.uint16]
Ints = NDArray[np.int64]


def checked(
    name: str,
    array: NDArray[np.generic],
    *,
    axes: tuple[str, ...],
    dtype: DTypeLike,
    unit: str,
    nonnegative: bool = True,
) -> NDArray[np.generic]:
    """Check rank, dtype, finiteness and sign of an array; return a read-only view of it.

    Parameters
    ----------
    name : str
        Name of the quantity, for the message.
    array : ndarray
        The array; it is not copied.
    axes : tuple of str
        Names of the axes expected.
    dtype : DTypeLike
        The exact dtype expected.
    unit : str
        Unit, for the message.
    nonnegative : bool
        Whether negative values are an error.

    Raises
    ------
    ValueCheckError
        With the place of the first offending element.
    """
    label = f"{name} [{unit}]"
    if array.ndim != len(axes):
        raise ValueCheckError(
            f"{label}: got an array of shape {array.shape}, expected axes ({', '.join(axes)})"
        )
    if array.dtype != np.dtype(dtype):
        raise ValueCheckError(
            f"{label}: got dtype {array.dtype}, expected {np.dtype(dtype)}; "
            f"cure: .astype(np.{np.dtype(dtype)}) where the loss of precision is meant"
        )
    if array.size == 0:
        raise ValueCheckError(f"{label}: got an empty array of shape {array.shape}")
    if array.dtype.kind == "f":
        # A sum is finite only if every element is: one cheap pass for the good case.
        if not np.isfinite(np.sum(array)) and len(bad := np.argwhere(~np.isfinite(array))):
            raise ValueCheckError(
                f"{label}: {len(bad)} values are not finite, the first at {tuple(map(int, bad[0]))}"
            )
        if nonnegative and float(array.min()) < 0:
            place = np.unravel_index(int(array.argmin()), array.shape)
            raise ValueCheckError(
                f"{label}: negative light, {float(array.min()):.4g} at {tuple(map(int, place))}"
            )
    view = array.view()
    view.flags.writeable = False
    return view
