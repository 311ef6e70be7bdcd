"""Scenes before the camera: lamps, materials, still objects, and movers as pure functions of time."""

from optsim.scene.bands import Band
from optsim.scene.bright import BrightLight, bright_lights
from optsim.scene.scene import Scene, list_scenes, load_scene

__all__ = [
    "Band",
    "BrightLight",
    "Scene",
    "bright_lights",
    "list_scenes",
    "load_scene",
]
