"""Files of learned priors, arrays and provenance in a compressed .npz, and their check against a camera."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from optsim.calibration.calibration import Calibration
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import atomic
from optsim.core.foreign.npz import npz_array
from optsim.core.quantities import Floats


class Prior(Protocol):
    """A learned prior of space-time patches."""

    @property
    def patch(self) -> int:
        """Side of a patch, panel pixels."""
        ...

    @property
    def slots(self) -> int:
        """Slots of a patch."""
        ...

    def shortened(self, slots: int) -> Self:
        """Return the prior of the first slots of its patches."""
        ...


def eight_bits(rows: Floats) -> tuple[NDArray[np.int8], Floats]:
    """Round rows, (n, ...), to 8-bit integers of the same shape, and a step each, (n,)."""
    steps = np.abs(rows).max(axis=tuple(range(1, rows.ndim))) / 127
    codes = np.rint(rows / steps.reshape(-1, *[1] * (rows.ndim - 1))).astype(np.int8)
    return codes, steps.astype(np.float32)


def write_prior(path: Path, arrays: Mapping[str, Any], provenance: Mapping[str, object]) -> None:
    """Write arrays by name, and provenance as JSON."""
    buffer = io.BytesIO()
    text = json.dumps(dict(provenance), allow_nan=False)
    np.savez_compressed(buffer, provenance=np.array(text), **arrays)
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def read_prior(path: Path, kind: str, names: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the named arrays and the provenance of a file of :func:`write_prior`."""
    if not path.is_file():
        raise StorageError(f"no such {kind}: {path}; make one with 'optsim train'")
    try:
        provenance = json.loads(str(npz_array(path, "provenance")))
        return {name: npz_array(path, name) for name in names}, provenance
    except (StorageError, ValueError) as error:
        why = str(error).removeprefix(f"{path} ")
        raise StorageError(f"{path} is not a {kind}: {why}") from None


PriorT = TypeVar("PriorT", bound=Prior)


def fitted(prior: PriorT, kind: str, calibration: Calibration) -> PriorT:
    """Return the prior for a camera's frames, shortened if they have fewer slots.

    Raises
    ------
    ConfigError
        When frames have more slots, or are smaller than a patch, with the cure.
    """
    slots = calibration.slots_per_frame
    if prior.slots < slots or prior.patch > min(calibration.shape):
        raise ConfigError(
            f"{kind}: got patches of {prior.patch} pixels and {prior.slots} slots, expected at least {slots} "
            f"slots and at most {min(calibration.shape)} pixels; cure: decode with interpolation or "
            "total_variation, which need no prior"
        )
    return prior if prior.slots == slots else prior.shortened(slots)
