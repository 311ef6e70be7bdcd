"""Arrays, images and films with their stated meaning, as truth in place of a scene."""

from optsim.footage.made import footage, still
from optsim.footage.source import FootageSource
from optsim.footage.truth import FootageTruth, open_footage

__all__ = ["FootageSource", "FootageTruth", "footage", "open_footage", "still"]
