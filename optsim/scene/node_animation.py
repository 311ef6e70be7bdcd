# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Animations of the nodes of a glTF file, which trimesh leaves out: translation, rotation and scale in time.

Skins and morph targets are refused: they deform, and a ``vertices`` mover does that.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from optsim.core.foreign import reading
from optsim.core.quantities import Doubles
from optsim.scene.gltf import gltf_parts

_PATHS = ("translation", "rotation", "scale")
_SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
# Component type -> its kind, and the largest value of what is normalised (glTF 2.0, section 3.11).
_NUMBERS = {
    5126: ("<f4", 0),
    5120: ("i1", 127),
    5121: ("u1", 255),
    5122: ("<i2", 32767),
    5123: ("<u2", 65535),
}


@dataclass(frozen=True, eq=False)
class Channel:
    """One property of one node in time.

    Parameters
    ----------
    node : int
        Index of the node.
    path : str
        ``translation``, ``rotation`` (a quaternion x, y, z, w) or ``scale``.
    times_s : ndarray of shape (k,), float64
        Keyframes.
    values : ndarray of shape (k, 3 or 4), or (k, 3, 3 or 4) of cubic splines, float64
        Values there; of splines in-tangent, value and out-tangent.
    interpolation : {"LINEAR", "STEP", "CUBICSPLINE"}
        Between them.
    """

    node: int
    path: str
    times_s: Doubles
    values: Doubles
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"]

    def at(self, time_s: float) -> Doubles:
        """Value at a time; before the first and after the last keyframe that of the nearest."""
        cubic = self.interpolation == "CUBICSPLINE"
        keys = self.values[:, 1] if cubic else self.values
        after = int(np.searchsorted(self.times_s, time_s, side="right"))
        if after == 0 or after == len(keys):
            value = keys[min(after, len(keys) - 1)]
        else:
            step = self.times_s[after] - self.times_s[after - 1]
            share = (time_s - self.times_s[after - 1]) / step
            start, stop = keys[after - 1], keys[after]
            if cubic:
                s2, s3 = share**2, share**3
                out, into = self.values[after - 1, 2] * step, self.values[after, 0] * step
                value = (2 * s3 - 3 * s2 + 1) * start + (s3 - 2 * s2 + share) * out
                value = value + (3 * s2 - 2 * s3) * stop + (s3 - s2) * into
            elif self.interpolation == "STEP":
                value = start
            elif self.path == "rotation":
                # Imported here: it is slow to import, and few scenes need it.
                from scipy.spatial.transform import Rotation, Slerp

                value = Slerp([0, 1], Rotation.from_quat([start, stop]))(share).as_quat()
            else:
                value = (1 - share) * start + share * stop
        return value / np.linalg.norm(value) if self.path == "rotation" else value


@dataclass(frozen=True, eq=False)
class NodeAnimation:
    """First animation of a file.

    Parameters
    ----------
    channels : tuple of Channel
        What changes.
    nodes : list of dict
        The file's nodes, as it has them.
    """

    channels: tuple[Channel, ...]
    nodes: list[dict[str, Any]]

    @property
    def duration_s(self) -> float:
        """Time of the last keyframe, s."""
        return max(float(channel.times_s[-1]) for channel in self.channels)

    def local_matrices(self, time_s: float) -> dict[int, Doubles]:
        """Matrix of each animated node in its parent's frame, (4, 4)."""
        changed: dict[int, dict[str, Doubles]] = {}
        for channel in self.channels:
            changed.setdefault(channel.node, {})[channel.path] = channel.at(time_s)
        return {node: _matrix({**self.nodes[node], **values}) for node, values in changed.items()}


def read_animation(path: Path) -> NodeAnimation | None:
    """Read the first animation of a glTF or GLB file that moves nodes; None if there is none.

    Raises
    ------
    StorageError
        For a damaged file.
    """
    with reading(path, "a glTF 2.0 file", "export it again, for example as GLB"):
        header, binary = gltf_parts(path)
        for animation in header.get("animations", []):
            channels = [
                _channel(header, binary, path, animation["samplers"][each["sampler"]], each["target"])
                for each in animation["channels"]
                if each["target"].get("path") in ("translation", "rotation", "scale")
                and "node" in each["target"]
            ]
            if channels:
                return NodeAnimation(tuple(channels), header["nodes"])
    return None


def _channel(
    header: dict[str, Any], binary: bytes, path: Path, sampler: dict[str, Any], target: dict[str, Any]
) -> Channel:
    times = _accessor(header, binary, path, sampler["input"])[:, 0]
    values = _accessor(header, binary, path, sampler["output"])
    kind = sampler.get("interpolation", "LINEAR")
    if kind == "CUBICSPLINE":
        values = values.reshape(len(times), 3, -1)
    if not (len(times) == len(values) > 0 and (np.diff(times) > 0).all() and np.isfinite(values).all()):
        raise ValueError("an animation whose keyframes don't fit its values")
    return Channel(int(target["node"]), target["path"], times, values, kind)


def _accessor(header: dict[str, Any], binary: bytes, path: Path, index: int) -> Doubles:
    """Rows of an accessor; those of animations are never interleaved."""
    accessor = header["accessors"][index]
    view = header["bufferViews"][accessor["bufferView"]]
    uri = header["buffers"][view["buffer"]].get("uri")
    if uri is None:
        content = binary
    elif uri.startswith("data:"):
        content = base64.b64decode(uri.partition(",")[2])
    else:
        content = (path.parent / uri).read_bytes()
    kind, largest = _NUMBERS[accessor["componentType"]]
    width, count = _SIZES[accessor["type"]], int(accessor["count"])
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    numbers: NDArray[Any] = np.frombuffer(content, kind, width * count, start)
    rows = numbers.astype(np.float64).reshape(count, width)
    return np.maximum(rows / largest, -1) if largest else rows


def _matrix(node: dict[str, Any]) -> Doubles:
    """Matrix of a node from its translation, rotation and scale."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix[:3, :3] *= np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def world_matrices(animation: NodeAnimation, roots: Sequence[int], time_s: float) -> dict[int, Doubles]:
    """Matrix of each node in the file's frame at a time, (4, 4)."""
    local = animation.local_matrices(time_s)
    found: dict[int, Doubles] = {}
    waiting = [(root, np.eye(4)) for root in roots]
    while waiting:
        node, above = waiting.pop()
        about = animation.nodes[node]
        if "matrix" in about and node not in local:
            own = np.asarray(about["matrix"], np.float64).reshape(4, 4).T
        else:
            own = local.get(node, _matrix(about))
        found[node] = above @ own
        waiting += [(child, found[node]) for child in about.get("children", [])]
    return found
