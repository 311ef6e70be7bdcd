"""What is in front of the camera: scenes, movers as pure functions of time, and footage as truth."""

from optsim.scene.bands import Band
from optsim.scene.bright import BrightLight, bright_lights
from optsim.scene.footage import footage, still
from optsim.scene.footage_source import FootageSource
from optsim.scene.footage_truth import FootageTruth, open_footage
from optsim.scene.scene import Scene, list_scenes, load_scene

__all__ = [
    "Band",
    "BrightLight",
    "FootageSource",
    "FootageTruth",
    "Scene",
    "bright_lights",
    "footage",
    "list_scenes",
    "load_scene",
    "open_footage",
    "still",
]
