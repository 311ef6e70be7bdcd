"""Still objects of a scene, as in ``scene.toml``."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from optsim.core.config import Part
from optsim.core.extensions import AS_IT_IS, OBJECTS, or_offered
from optsim.scene import geometry
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh
from optsim.scene.mesh_objects import MeshObject
from optsim.scene.solids import Solid


def check_edges(u_m: Vector, v_m: Vector, *, orthogonal: bool) -> None:
    """Raise a ValueError unless two edges span an area, at right angles if required; at any scale."""
    u, v = np.asarray(u_m), np.asarray(v_m)
    area = float(np.linalg.norm(u) * np.linalg.norm(v))
    if not np.linalg.norm(np.cross(u, v)) > 1e-6 * area or (orthogonal and abs(np.dot(u, v)) > 1e-6 * area):
        wanted = "orthogonal and not zero" if orthogonal else "neither parallel nor zero"
        raise ValueError(f"edge_u_m and edge_v_m must be {wanted}; got {list(u_m)} and {list(v_m)}")


class Quad(Part):
    """Flat rectangle, for example a poster; faces ``edge_u x edge_v``.

    Parameters
    ----------
    fit : bool
        Stretch one texture tile over the whole (with the material's ``tile_m`` = 1), instead of by metres.
    """

    kind: Literal["quad"] = "quad"
    material: str
    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    fit: bool = False

    @model_validator(mode="after")
    def _has_area(self) -> Quad:
        check_edges(self.edge_u_m, self.edge_v_m, orthogonal=False)
        return self

    def mesh(self) -> Mesh:
        """Make the triangles."""
        uv = [[0, 0], [1, 0], [1, 1], [0, 1]] if self.fit else None
        return geometry.quad(self.corner_m, self.edge_u_m, self.edge_v_m, uv)


class Box(Part):
    """Box, rotated about the vertical."""

    kind: Literal["box"] = "box"
    material: str
    center_m: Vector
    size_m: tuple[Positive, Positive, Positive]
    yaw_rad: float = 0.0

    def mesh(self) -> Mesh:
        """Make the triangles."""
        return geometry.box(self.center_m, self.size_m, self.yaw_rad)


class Wall(Part):
    """Wall with rectangular holes (u0, v0, u1, v1 in metres along its edges) and their reveals."""

    kind: Literal["wall"] = "wall"
    material: str
    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    holes_m: tuple[tuple[float, float, float, float], ...] = ()
    depth_m: Positive = 0.15

    @model_validator(mode="after")
    def _has_area(self) -> Wall:
        check_edges(self.edge_u_m, self.edge_v_m, orthogonal=True)
        return self

    def mesh(self) -> Mesh:
        """Make the triangles."""
        return geometry.wall(self.corner_m, self.edge_u_m, self.edge_v_m, self.holes_m, self.depth_m)


class Rod(Part):
    """Round rod with ball ends, possibly tapered: legs of tables, poles, pots."""

    kind: Literal["rod"] = "rod"
    material: str
    start_m: Vector
    stop_m: Vector
    radius_m: Positive
    radius_stop_m: Positive | None = None

    @model_validator(mode="after")
    def _has_length(self) -> Rod:
        if self.start_m == self.stop_m:
            raise ValueError(
                f"start_m and stop_m must differ; got {list(self.start_m)} twice; cure: use a globe"
            )
        return self

    def mesh(self) -> Mesh:
        """Make the triangles."""
        start, stop = np.asarray(self.start_m), np.asarray(self.stop_m)
        side = np.eye(3)[int(np.argmin(np.abs(stop - start)))]
        return geometry.limb(
            start, stop, self.radius_m, self.radius_stop_m or self.radius_m, side=side, around=16
        )


class Globe(Part):
    """Ball at rest."""

    kind: Literal["globe"] = "globe"
    material: str
    center_m: Vector
    radius_m: Positive

    def mesh(self) -> Mesh:
        """Make the triangles."""
        return geometry.ball(self.center_m, self.radius_m)


class Plant(Part):
    """Bush of bent leaves on stalks from one point, seeded.

    Parameters
    ----------
    base_m : vector
        Point where the stalks start.
    height_m : float
        Approximate height of the highest leaf tip.
    n_leaves, seed : int
        Number of leaves, and seed of their shape.
    """

    kind: Literal["plant"] = "plant"
    material: str
    base_m: Vector
    height_m: Positive
    n_leaves: int = Field(36, ge=1, le=400)
    seed: int = 0

    def mesh(self) -> Mesh:
        """Make the triangles."""
        rng = np.random.default_rng(self.seed)
        leaf = geometry.sheet(3, 7)
        leaves: list[Mesh] = []
        for yaw in np.arange(self.n_leaves) * 2.399963:  # the golden angle spreads them evenly
            reach, rise = self.height_m * rng.uniform(0.15, 0.5), self.height_m * rng.uniform(0.45, 1.0)
            along = leaf.uv[:, 1]
            width = self.height_m * 0.16 * np.sin(np.pi * np.clip(along * 0.92 + 0.04, 0, 1)) ** 0.8
            shape = np.stack(
                [
                    (leaf.uv[:, 0] - 0.5) * width,
                    -reach * along**0.8,
                    rise * (along - 0.55 * along**3) / 0.45,
                ],
                axis=-1,
            )
            leaves.append(
                Mesh(geometry.turn(shape, float(yaw)) + np.asarray(self.base_m), leaf.faces, leaf.uv)
            )
        return geometry.merge(leaves)


StillObject = Annotated[
    Quad | Box | Wall | Rod | Globe | Plant | Solid | MeshObject,
    Field(discriminator="kind"),
    or_offered(OBJECTS, Part),
    AS_IT_IS,
]
