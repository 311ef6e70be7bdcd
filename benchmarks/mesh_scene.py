# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Make a scene of models from files: a room, two models at rest, and two that move.

The models are bodies of noise on a sphere, 20 000 triangles each, written as GLB and as PLY by trimesh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from optsim.core.quantities import Doubles
from optsim.scene import Scene, load_scene

_SCENE = """name = "mesh_scene"
description = "four models from files in a room; two move"
white_w_m2_sr = 1.0
max_depth = 5
[camera]
position_m = [0.0, -2.6, 1.3]
target_m = [0.0, 0.6, 0.8]
[materials]
wall = { texture = "wallpaper", tile_m = 0.3, reflectance = 0.8 }
floor = { texture = "planks", tile_m = 0.6, reflectance = 0.8 }
stone = { reflectance = 0.5 }
clay = { texture = "speckle", tile_m = 0.3, reflectance = 0.9 }
[lamps.ceiling]
center_m = [0.4, 0.2, 2.6]
edge_u_m = [1.0, 0.0, 0.0]
edge_v_m = [0.0, -0.6, 0.0]
radiance_w_m2_sr = 20.0
[objects.back]
kind = "quad"
material = "wall"
corner_m = [-2.2, 1.8, 0.0]
edge_u_m = [4.4, 0.0, 0.0]
edge_v_m = [0.0, 0.0, 2.7]
[objects.floor]
kind = "quad"
material = "floor"
corner_m = [-2.2, -3.0, 0.0]
edge_u_m = [4.4, 0.0, 0.0]
edge_v_m = [0.0, 4.8, 0.0]
[objects.statue]
kind = "mesh"
file = "statue.glb"
material = "stone"
position_m = [-0.9, 0.9, 0.6]
[objects.rock]
kind = "mesh"
file = "rock.ply"
up = "z"
unit = "m"
material = "stone"
position_m = [0.8, 0.4, 0.35]
[movers.spinning]
kind = "mesh"
file = "statue.glb"
material = "clay"
times_s = [0.0, 1.0]
positions_m = [[-0.2, 0.2, 1.1], [0.1, 0.2, 1.2]]
spin_hz = 1.0
[movers.crossing]
kind = "mesh"
file = "rock.ply"
up = "z"
unit = "m"
material = "clay"
times_s = [0.0, 1.0]
positions_m = [[-1.3, -0.1, 0.4], [1.3, -0.1, 0.5]]
spin_hz = 0.5
"""


def make_mesh_scene(folder: Path) -> Scene:
    """Write the models and the scene into a folder, and read it."""
    _body(1, 0.5).export(folder / "statue.glb")
    _body(2, 0.3).export(folder / "rock.ply")
    path = folder / "scene.toml"
    path.write_text(_SCENE)
    return load_scene(path)


def _body(seed: int, size_m: float) -> trimesh.Trimesh:
    """Make a sphere of 20 480 triangles, its radius a sum of a few waves."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=size_m / 2)
    rng = np.random.default_rng(seed)
    unit: Doubles = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    waves = rng.normal(0, 4, (12, 3))
    height = np.sin(unit @ waves.T + rng.uniform(0, 2 * np.pi, 12)).sum(axis=1)
    return trimesh.Trimesh(sphere.vertices * (1 + 0.04 * height)[:, None], sphere.faces, process=False)
