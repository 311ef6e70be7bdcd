"""Arrays of a sample by name: unit, axes, and the files that hold them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.files import read_exr, read_record
from optsim.core.foreign import reading

Array = NDArray[Any]


@dataclass(frozen=True)
class Pass:
    """A named array of the truth: several channels become an axis of their own."""

    channels: tuple[str, ...]  # in a slot's file
    unit: str  # SI, or the meaning of the numbers
    axes: str = "slot, y, x"  # of a sequence

    def read(self, path: Path) -> Array:
        """Read the array of one slot."""
        channels = read_exr(path)[0]
        arrays = [channels[name] for name in self.channels]
        array = np.stack(arrays, axis=0 if "band" in self.axes else -1) if len(arrays) > 1 else arrays[0]
        return array.astype(np.bool_) if self.unit == "mask" else array


_FLOW_AXES, _NORMAL_AXES = "slot, y, x, (row, col)", "slot, y, x, (x, y, z)"
PASSES = {
    "radiance": Pass(("Y",), "W m^-2 sr^-1"),
    "colour": Pass(("R", "G", "B"), "W m^-2 sr^-1, in the bands R, G and B", "slot, band, y, x"),
    "radiance_sigma": Pass(("Y.sigma",), "W m^-2 sr^-1"),
    "depth": Pass(("Z",), "m, along the optical axis"),
    "distance": Pass(("distance",), "m, along the ray"),
    "normal": Pass(("N.X", "N.Y", "N.Z"), "1, world axes", _NORMAL_AXES),
    "albedo": Pass(("albedo",), "1"),
    "id": Pass(("id",), "object id"),
    "part": Pass(("part",), "part of an object"),
    "flow_forward": Pass(("flow.forward.row", "flow.forward.col"), "fine samples", _FLOW_AXES),
    "flow_backward": Pass(("flow.backward.row", "flow.backward.col"), "fine samples", _FLOW_AXES),
    "occluded_forward": Pass(("occluded.forward",), "mask"),
    "occluded_backward": Pass(("occluded.backward",), "mask"),
    "moving": Pass(("moving",), "mask"),
}


@dataclass(frozen=True)
class Coded:
    """A kind of array with one file a coded frame or slot."""

    files: str  # pattern below the folder of the sequence or, of schemes, of the seed and kind
    unit: str
    axes: str
    read: Callable[[Path], Array]


def _slots(path: Path) -> Array:
    channels, _ = read_exr(path)
    return np.stack([channels[name] for name in sorted(channels)])


def _levels(path: Path) -> Array:
    return _slots(path).astype(np.uint8)


def _channel(name: str) -> Callable[[Path], Array]:
    return lambda path: read_exr(path)[0][name]


def _numbers(path: Path) -> Array:
    from PIL import Image

    with reading(path, "PNG"), Image.open(path) as image:
        return np.asarray(image).astype(np.uint16)


_LIGHT = "W m^-2 sr^-1, irradiance on the panel over light/irradiance_per_radiance"
SHARED = {
    "target": Coded("target/*.exr", f"{_LIGHT}, shading divided out", "frame, slot, v, u", _slots),
    "light_on_panel": Coded("light_on_panel/*.exr", _LIGHT, "slot, y, x", _channel("E")),
}
"""Arrays of a sequence that all schemes and seeds share, beside the passes."""
BY_SCHEME = {
    "frames": Coded("frames/{}/*.png", "DN", "frame, y, x", _numbers),
    "expected": Coded("expected/{}/*.exr", "DN, without noise", "frame, y, x", _channel("expected")),
    "sigma": Coded("expected/{}/*.exr", "DN, temporal noise rms", "frame, y, x", _channel("sigma")),
    "masks": Coded("masks/{}/*.png", "mask", "frame, v, u", lambda path: _numbers(path) > 0),
    "codes": Coded("codes/{}/*.exr", "drive level, 0..255", "frame, slot, v, u", _levels),
    "weights": Coded("weights/{}/*.exr", "1, effective weight as calibrated", "frame, slot, v, u", _slots),
    "transmission": Coded(
        "transmission/{}/*.exr", "1, of the panel, fully on as 1", "frame, slot, y, x", _slots
    ),
    "reconstructions": Coded("reconstructions/{}/*.exr", "W m^-2 sr^-1", "frame, slot, v, u", _slots),
}
"""Arrays of each scheme, KIND/SCHEME."""
_OPERATOR = {
    "row": ("CCD pixel", "v, u"),
    "col": ("CCD pixel", "v, u"),
    "black_dn": ("DN", "v, u"),
    "gain_dn": ("DN / (W m^-2 slot)", "v, u"),
    "core": ("share of the light", "v, u, dy, dx"),
    "tails": ("share of the light", "dv, du"),
    "mirrored": ("share of the light, of the opposite pixels", "dv, du"),
    "veil": ("share of the light", ""),
    "bend": ("share of the signal at full_dn", ""),
    "full_dn": ("DN above black", ""),
}
_LIGHT_UNITS = {
    "nd_transmission": "1",
    "wanted_transmission": "1",
    "percentile_dn": "DN above black",
    "saturation_dn": "DN above black",
    "irradiance_per_radiance": "W m^-2 / (W m^-2 sr^-1)",
    "gain_e_dn": "electrons / DN",
}


@dataclass(frozen=True)
class Table:
    """A file of several named arrays, .npz, or of numbers, .json."""

    path: Path

    def names(self) -> list[str]:
        """Names of the arrays."""
        if self.path.suffix == ".json":
            return [name for name in _LIGHT_UNITS if name in read_record(self.path)]
        with reading(self.path, "NPZ"), self.path.open("rb") as file, np.load(file) as stored:
            return [name for name in stored.files if name != "about"]

    def read(self, name: str) -> Array:
        """Read one array."""
        if self.path.suffix == ".json":
            return np.asarray(read_record(self.path)[name], np.float64)
        with reading(self.path, "NPZ"), self.path.open("rb") as file, np.load(file) as stored:
            array = stored[name]
        return array.astype(np.float32) if array.dtype == np.float16 else array

    def meaning(self, name: str) -> tuple[str, str]:
        """Return unit and axes of an array."""
        if self.path.suffix == ".json":
            return _LIGHT_UNITS[name], ""
        if name in _OPERATOR and self.path.stem == "operator":
            return _OPERATOR[name]
        with reading(self.path, "NPZ"), self.path.open("rb") as file, np.load(file) as stored:
            said = json.loads(str(stored["about"].item()))["arrays"][name]
        return said["unit"], said["axes"]


def tables(folder: Path, seed_folder: Path) -> dict[str, Table]:
    """Files of named arrays of a sample, by the first part of their names; those that are there."""
    listed = [folder / "operator.npz", seed_folder / "light.json"]
    listed += sorted(seed_folder.glob("calibration*.npz"))
    return {path.stem: Table(path) for path in listed if path.is_file()}
