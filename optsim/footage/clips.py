"""A user's own high-speed footage as training clips: slot means of one band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from optsim.core.cache import hash_of
from optsim.core.errors import ConfigError, ValueCheckError
from optsim.core.files import content_hash
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats
from optsim.footage.recording import VIDEOS, Recording, array_axes, naming, open_recording
from optsim.footage.source import FootageSource

Linearisation = Literal["linear", "srgb"]
# Keys in the messages of the footage readers, and the options that replace them here.
_OPTIONS = {
    "source.footage.path": "--clips",
    "source.footage.key: missing": "--clips: expected one array, or the channels Y or R, G and B",
    "source.footage.black_level": "--black-level",
    "source.footage.linearisation": "--linearisation",
}
_COLOURS = 3


@dataclass(frozen=True, eq=False)
class ImportedClip:
    """Footage for training: its files, and the meaning of their values.

    Parameters
    ----------
    recording : Recording
        The files.
    source : FootageSource
        Conversion of a stored value to light.
    frames_per_slot : int
        Frames averaged in a slot.
    """

    recording: Recording
    source: FootageSource
    frames_per_slot: int

    @property
    def n_slots(self) -> int:
        """Number of whole slots."""
        return self.recording.n_frames // self.frames_per_slot

    @property
    def name(self) -> str:
        """Name of the file, or of the folder of images, without its path."""
        files = self.recording.files
        return files[0].name if len(files) == 1 else files[0].resolve().parent.name

    def read(self, progress: Progress = silent) -> Floats:
        """Mean light in each slot, (slot, v, u), without a stated scale; all in memory.

        Frames at the end that don't fill a slot are left out.

        Raises
        ------
        ValueCheckError, StorageError
            For an invalid value of light, frames that differ in format, a file that ends early, or darkness.
        """
        clip = np.zeros((self.n_slots, *self.recording.shape[:2]), np.float32)
        frames = self.recording.read(0)
        for slot in range(self.n_slots):
            total = np.zeros(clip.shape[1:])
            for frame in range(slot * self.frames_per_slot, (slot + 1) * self.frames_per_slot):
                with naming(_OPTIONS):
                    total += self.source.radiance(next(frames), self.recording.where(frame)).w_m2_sr
            with np.errstate(over="ignore"):
                clip[slot] = total / self.frames_per_slot
            progress(f"footage {self.name}", slot + 1, self.n_slots)
        mean = float(clip.mean(dtype=np.float64))
        if not np.isfinite(mean):
            raise ValueCheckError(
                f"--clips {self.name}: holds values beyond what 32 bits can, {np.finfo(np.float32).max:.2g}; "
                "cure: divide them, scale has no part in learning"
            )
        if not mean > 0:
            raise ValueCheckError(
                f"--clips {self.name}: got no light above the black level, expected some; cure: "
                "leave the clip out, or correct --black-level"
            )
        return clip

    def record(self) -> dict[str, Any]:
        """Record for the provenance: names, a hash of the content, how it was read; no folders."""
        files = self.recording.files
        content = [content_hash(path) for path in files]
        return {
            "name": self.name,
            "files": len(files),
            "sha256": content[0] if len(files) == 1 else hash_of(content),
            "frames": self.recording.n_frames,
            "frames_per_slot": self.frames_per_slot,
            "linearisation": self.source.linearisation,
            "black_level": self.source.black_level,
        }


def open_clips(
    paths: Sequence[Path],
    *,
    frames_per_slot: int = 1,
    linearisation: Linearisation | None = None,
    black_level: float = 0.0,
    patch: int = 8,
    slots: int = 36,
) -> list[ImportedClip]:
    """Open training footage; its first frames are checked now, the others when it is read.

    Colour becomes luminance (ITU-R BT.709-6 of linear R, G, B). Values are never rescaled by their dtype:
    training doesn't depend on the scale.

    Parameters
    ----------
    paths : sequence of Path
        Each a folder or pattern of EXR, PNG or TIFF images, a TIFF stack, an npz, npy or mat file of one
        array, or a video. Arrays have time first, those of MATLAB last; colour channels follow the columns,
        or precede time.
    frames_per_slot : int
        Consecutive frames averaged in a slot.
    linearisation : {"linear", "srgb"}, optional
        Curve of the stored values; by default as the file states. Without a statement it is ``srgb`` (IEC
        61966-2-1) for whole numbers of 8 bits and for videos, ``linear`` for all others.
    black_level : float
        Stored value at zero light; only with linear footage.
    patch, slots : int
        Size of the patches to train, which is the least size of footage.

    Raises
    ------
    ConfigError, StorageError, ValueCheckError
        When files are missing, unreadable, too few or too small, with the option and the cure.
    """
    found: list[ImportedClip] = []
    for path in paths:
        with naming(_OPTIONS):
            recording = open_recording(path, axes=array_axes(path))
        n_frames, (rows, cols, channels) = recording.n_frames, recording.shape
        if n_frames < slots * frames_per_slot:
            raise ConfigError(
                f"--clips {path}: got {n_frames} frames, {n_frames // frames_per_slot} slots at "
                f"--frames-per-slot {frames_per_slot}, expected at least {slots} slots, "
                f"{slots * frames_per_slot} frames; cure: a longer recording"
                + (", or fewer frames a slot" if frames_per_slot > 1 else "")
            )
        if min(rows, cols) < patch:
            raise ConfigError(
                f"--clips {path}: got {rows} x {cols} pixels, expected at least {patch} x {patch}, those "
                "of a patch; cure: a larger recording (or is time not where it should be in this array?)"
            )
        if channels not in (1, _COLOURS):
            raise ConfigError(
                f"--clips {path}: got {channels} channels, expected 1 or {_COLOURS}: grey, or red, green and "
                "blue; cure: write one band, or three"
            )
        found.append(ImportedClip(recording, _source(recording, linearisation, black_level), frames_per_slot))
    return found


def _source(recording: Recording, linearisation: Linearisation | None, black_level: float) -> FootageSource:
    """State the meaning of stored values; training does not depend on radiance and time."""
    name, whole = recording.files[0].name, "int" in recording.dtype
    encoded = (whole and recording.bits <= 8) or recording.files[0].suffix.lower() in VIDEOS
    if recording.declared.curve is not None:
        encoded = recording.declared.curve != "linear"
    curve = linearisation or ("srgb" if encoded else "linear")
    if curve == "srgb" and not whole:
        raise ConfigError(
            f"--linearisation srgb: {name} holds {recording.dtype}, expected whole numbers, whose full scale "
            "is known; cure: --linearisation linear, or undo the curve before"
        )
    if black_level and curve != "linear":
        raise ConfigError(
            f"--black-level {black_level:g}: {name} is read as {curve}, and a level is subtracted from "
            "linear footage only; cure: --linearisation linear, or no level"
        )
    stated: dict[str, Any] = {
        "path": name,
        "frame_rate_hz": 1,
        "scale_w_m2_sr": 1,
        "white_w_m2_sr": 1,
        "linearisation": curve,
        "full_scale": float(np.iinfo(recording.dtype).max) if curve == "srgb" else None,
        "black_level": black_level,
        "channel_weights": "rec709" if recording.shape[2] == _COLOURS else None,
        "accept_8bit": True,
    }
    source = FootageSource(**stated)
    with naming(_OPTIONS):
        # Other primaries change the weights of colours, not the motion and texture that are learned.
        source.check_declared(recording.declared._replace(primaries=None), name)
    return source
