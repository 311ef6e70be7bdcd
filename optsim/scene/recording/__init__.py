"""Recordings as they lie on disk: files in, frames as stored out; what they mean is ``footage_source``'s."""

from optsim.scene.recording.files import open_recording
from optsim.scene.recording.film import Recording

__all__ = ["Recording", "open_recording"]
