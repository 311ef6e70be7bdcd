"""What stands still in a scene: camera pose, materials, lamps and objects, as in ``scene.toml``."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from optsim.config import Part
from optsim.errors import ConfigError
from optsim.scene import geometry
from optsim.scene.geometry import Mesh
from optsim.scene.textures import OUTSIDES, check_texture

Vector = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


def known_texture(name: str | None) -> str | None:
    """Texture names, checked while the part is built, so that the error names the key."""
    try:
        return None if name is None else check_texture(name)
    except ConfigError as error:
        raise ValueError(str(error)) from None


class CameraPose(Part):
    """Where the camera stands and looks; z is up, the picture is upright."""

    position_m: Vector
    target_m: Vector


class Material(Part):
    """Diffuse surface, both sides alike.

    Parameters
    ----------
    reflectance : float
        Hemispherical reflectance in the band; multiplies the texture where there is one.
    texture : str or None
        Name in :mod:`optsim.scene.textures`.
    tile_m : float
        Length of one texture tile along the surface, m (texture coordinates of movers count as metres).
    """

    reflectance: float = Field(0.5, ge=0, le=1)
    texture: str | None = None
    tile_m: Positive = 1.0

    _known = field_validator("texture")(known_texture)


class Lamp(Part):
    """Rectangular area light facing ``edge_u x edge_v``, uniform or with an HDR picture.

    Parameters
    ----------
    center_m, edge_u_m, edge_v_m : vector
        Centre and full edges.
    radiance_w_m2_sr : float
        Radiance; of the picture's relative 1 where there is one.
    picture : str or None
        Name of an outside in :mod:`optsim.scene.textures`; such a lamp is a window on the bright outside.
    sampling_weight : float
        Share of light samples, relative to other lamps; for low noise about its share of the light.
    """

    center_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    radiance_w_m2_sr: float = Field(gt=0)
    picture: str | None = None
    sampling_weight: Positive = 1.0

    @field_validator("picture")
    @classmethod
    def _known(cls, name: str | None) -> str | None:
        if name is not None and name not in OUTSIDES:
            raise ValueError(f"unknown outside; expected one of: {', '.join(OUTSIDES)}")
        return name

    @model_validator(mode="after")
    def _rectangle(self) -> Lamp:
        u, v = np.asarray(self.edge_u_m), np.asarray(self.edge_v_m)
        if min(np.linalg.norm(u), np.linalg.norm(v)) < 1e-6 or abs(np.dot(u, v)) > 1e-6:
            raise ValueError("edge_u_m and edge_v_m of a lamp must be orthogonal and not zero")
        return self


class Quad(Part):
    """Flat rectangle, for example a poster; faces ``edge_u x edge_v``.

    Parameters
    ----------
    fit : bool
        Stretch one texture tile over the whole (with the material's ``tile_m`` = 1), rather than by metres.
    """

    kind: Literal["quad"] = "quad"
    material: str
    corner_m: Vector
    edge_u_m: Vector
    edge_v_m: Vector
    fit: bool = False

    def mesh(self) -> Mesh:
        """Make the triangles."""
        uv = [[0, 0], [1, 0], [1, 1], [0, 1]] if self.fit else None
        return geometry.quad(self.corner_m, self.edge_u_m, self.edge_v_m, uv)


class Box(Part):
    """Box, turned about the vertical."""

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
        Where the stalks start.
    height_m : float
        Height of the highest leaf tip, about.
    n_leaves, seed : int
        How many, and which.
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


StillObject = Annotated[Quad | Box | Wall | Rod | Globe | Plant, Field(discriminator="kind")]
