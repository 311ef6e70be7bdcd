# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Nodes of a glTF file, at rest and by its animation: translation, rotation and scale in time.

Skins and morph targets are refused: they deform, and a ``vertices`` mover does that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from optsim.core.quantities import Doubles
from optsim.scene.gltf import Gltf

_PATHS = ("translation", "rotation", "scale")
# Matrices as near as this, of their largest entry, are the same.
_SAME = 1e-9


@dataclass(frozen=True, eq=False)
class Channel:
    """One property of one node in time: translation, rotation (quaternion x, y, z, w) or scale."""

    node: int
    path: str
    times_s: Doubles
    values: Doubles  # (k, 3 or 4); of cubic splines (k, 3, 3 or 4): in-tangent, value, out-tangent
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"]

    def varies(self) -> bool:
        """Whether it has another value at any time."""
        still = self.values[:1] * ([[0], [1], [0]] if self.interpolation == "CUBICSPLINE" else 1)
        return bool((self.values != still).any())

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
class NodeTree:
    """Tree of nodes that a file shows, and its first animation that moves any."""

    nodes: list[dict[str, Any]]
    roots: tuple[int, ...]
    channels: tuple[Channel, ...]

    @property
    def duration_s(self) -> float:
        """Time of the last keyframe, s."""
        return max(float(channel.times_s[-1]) for channel in self.channels)

    def moving(self) -> dict[int, int]:
        """Visible nodes that the animation moves, or puts elsewhere than at rest, and what moves each."""
        first, rest = self.matrices(0.0), self.matrices()
        varying = {channel.node for channel in self.channels if channel.varies()}
        found: dict[int, int] = {}
        waiting: list[tuple[int, int | None]] = [(root, None) for root in self.roots if root in rest]
        while waiting:
            node, above = waiting.pop()
            # The nearest node, itself or above, whose keyframes differ: nodes that share it move as one.
            by = node if node in varying else above
            if by is not None or np.abs(first[node] - rest[node]).max() > _SAME * np.abs(rest[node]).max():
                found[node] = node if by is None else by
            waiting += [(child, by) for child in self.nodes[node].get("children", []) if child in rest]
        return found

    def matrices(self, time_s: float | None = None) -> dict[int, Doubles]:
        """Matrix of each visible node in the file's frame at a time, or at rest; (4, 4)."""
        changed: dict[int, dict[str, Doubles]] = {}
        for channel in self.channels if time_s is not None else ():
            changed.setdefault(channel.node, {})[channel.path] = channel.at(time_s or 0.0)
        found: dict[int, Doubles] = {}
        waiting = [(root, np.eye(4)) for root in self.roots]
        while waiting:
            node, above = waiting.pop()
            if node in found or not 0 <= node < len(self.nodes):
                raise ValueError(f"nodes[{node}] is named twice, or is not there")
            about = self.nodes[node]
            if not about.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True):
                continue
            if "matrix" in about and node not in changed:
                own = np.asarray(about["matrix"], np.float64).reshape(4, 4).T
            else:
                own = _matrix({**about, **changed.get(node, {})})
            found[node] = above @ own
            waiting += [(child, found[node]) for child in about.get("children", [])]
        return found


def read_nodes(gltf: Gltf) -> NodeTree:
    """Read the tree of the file's scene, of all nodes where it has none."""
    header = gltf.header
    nodes: list[dict[str, Any]] = header.get("nodes", [])
    below = {child for node in nodes for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in below]
    if header.get("scenes"):
        roots = gltf.entry("scenes", header.get("scene", 0)).get("nodes", [])
    for number, animation in enumerate(header.get("animations", [])):
        channels = [
            _channel(gltf, animation, each, f"animations[{number}]")
            for each in animation["channels"]
            if each["target"].get("path") in _PATHS and "node" in each["target"]
        ]
        # What an animation leaves of a matrix is unknown, unless it states all three.
        moved = [each.node for each in channels]
        if bad := [node for node in moved if "matrix" in nodes[node] and moved.count(node) < len(_PATHS)]:
            raise ValueError(f"nodes[{bad[0]}] has a matrix, which animations[{number}] changes in part")
        if channels:
            return NodeTree(nodes, tuple(roots), tuple(channels))
    return NodeTree(nodes, tuple(roots), ())


def _channel(gltf: Gltf, animation: dict[str, Any], channel: dict[str, Any], where: str) -> Channel:
    sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
    gltf.entry("nodes", target["node"])
    times = gltf.numbers(sampler["input"])[:, 0]
    values = gltf.numbers(sampler["output"])
    kind = sampler.get("interpolation", "LINEAR")
    if kind == "CUBICSPLINE":
        values = values.reshape(len(times), 3, -1)
    if not (len(times) == len(values) > 0 and np.isfinite(values).all()):
        raise ValueError(f"{where}: its keyframes don't fit its values")
    if not (np.diff(times) > 0).all():
        raise ValueError(f"{where}: its times don't increase")
    if kind not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise ValueError(f"{where}: its interpolation is {kind!r}")
    if target["path"] == "rotation" and not (values[:, 1] if kind == "CUBICSPLINE" else values).any(1).all():
        raise ValueError(f"{where}: a rotation is 0")
    return Channel(target["node"], target["path"], times, values, kind)


def _matrix(node: dict[str, Any]) -> Doubles:
    """Matrix of a node from its translation, rotation and scale."""
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    matrix[:3, :3] *= np.asarray(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
