# pyright: reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Recorded footage as truth: exact means over slots and fine samples, frame by frame, through the cache."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from optsim.core.cache import Arrays, Cache, hash_of
from optsim.core.code_hash import hash_files
from optsim.core.errors import ConfigError, GeometryError
from optsim.core.files import content_hash
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Doubles, RadianceVideo, Segment, Timing, View
from optsim.footage.recording import Recording, open_recording
from optsim.footage.source import FootageSource, RecordedLight

CODE = ("optsim/footage/**/*.py", "optsim/core/foreign/*.py")
"""Code that decides an import: an old cache never answers for new code."""
# Decimals of a footage frame or pixel to which a boundary is known: 180 Hz footage has whole slots.
_DECIMALS = 9


def overlap(start: float, stop: float) -> tuple[int, Doubles]:
    """Shares of unit samples in the mean over an interval."""
    low, high = round(start, _DECIMALS), round(stop, _DECIMALS)
    edges = np.arange(int(low), int(np.ceil(high)) + 1)
    lengths = np.diff(np.clip(edges, low, high))
    return int(low), lengths / lengths.sum()


def cell_shares(margin: float, step: float, n_cells: int, n_samples: int) -> csr_array:
    """Share of each sample in each cell of one length, so that ``shares @ samples`` are means over cells."""
    found = [overlap(margin + step * cell, margin + step * (cell + 1)) for cell in range(n_cells)]
    samples = np.concatenate([first + np.arange(len(weights)) for first, weights in found])
    cells = np.repeat(np.arange(n_cells), [len(weights) for _, weights in found])
    values = np.concatenate([weights for _, weights in found])
    return csr_array((values, (cells, samples)), shape=(n_cells, n_samples))


@dataclass(frozen=True, eq=False)
class FootageTruth:
    """A recording for a camera: the user's statements, checked against its files.

    Parameters
    ----------
    source : FootageSource
        The user's statements.
    recording : Recording
        The files.
    view : View
        Fine grid to fill.
    timing : Timing
        Slots to fill.
    """

    source: FootageSource
    recording: Recording
    view: View
    timing: Timing

    @property
    def frames_per_slot(self) -> float:
        """Number of footage frames in a slot."""
        return self.source.frame_rate_hz * self.timing.slot_s

    @cached_property
    def pixels_per_sample(self) -> float:
        """Footage pixels along a fine sample.

        Raises
        ------
        GeometryError
            When the footage doesn't fit the fine grid in the stated way.
        """
        rows, cols, _ = self.recording.shape
        grid = self.view.rows, self.view.cols
        said = (
            f"source.footage.fit = '{self.source.fit}': the footage has {rows} x {cols} pixels, the fine grid"
        )
        if self.source.fit == "area":
            return min(rows / grid[0], cols / grid[1])
        if self.source.fit == "exact" and (rows, cols) != grid:
            raise GeometryError(
                f"{said} (camera.view) {grid[0]} x {grid[1]}; state 'crop' for its middle one to one, or "
                "'area' for averages over areas, or change camera.panel_rows and panel_cols"
            )
        if rows < grid[0] or cols < grid[1]:
            raise GeometryError(f"{said} (camera.view) {grid[0]} x {grid[1]}, which is larger; state 'area'")
        return 1.0

    @cached_property
    def _fit(self) -> tuple[csr_array, csr_array]:
        step = self.pixels_per_sample
        rows, cols, _ = self.recording.shape
        # Round to a whole pixel where pixels are kept: half of one would blur all of them.
        margins = [(n - step * m) / 2 for n, m in ((rows, self.view.rows), (cols, self.view.cols))]
        if step == 1:
            margins = [float(int(margin)) for margin in margins]
        return (
            cell_shares(margins[0], step, self.view.rows, rows),
            cell_shares(margins[1], step, self.view.cols, cols),
        )

    def frames_of(self, slot: int) -> tuple[int, Doubles]:
        """First footage frame of a slot, and the shares of it and its successors in the slot's mean."""
        start = self.source.first_frame + slot * self.frames_per_slot
        return overlap(start, start + self.frames_per_slot)

    def check(self) -> None:
        """Check for obstacles to an import, from the files' headers and the first frame.

        Raises
        ------
        ConfigError, GeometryError
            With the key and the cure.
        """
        stated, held = self.source, self.recording
        if held.bits <= 8 and not stated.accept_8bit:
            raise ConfigError(
                f"source.footage.accept_8bit: {held.files[0].name} holds {held.bits} bits, in which a high "
                "dynamic range is lost; use the recording's 10 to 16 bits, or consent with accept_8bit = true"
            )
        if stated.full_scale is None and "int" in held.dtype:
            raise ConfigError(
                f"source.footage.full_scale: missing; the footage holds {held.dtype}: state the value that "
                "means a signal of 1 (65535 for all of 16 bits and for videos, 16383 for 14 bits kept in 16)"
            )
        stated.check_declared(held.declared, held.files[0].name)
        highest = float(np.iinfo(held.dtype).max) if "int" in held.dtype else np.inf
        decoded = held.bits < 8 * np.dtype(held.dtype).itemsize
        if stated.full_scale and (stated.full_scale > highest or (decoded and stated.full_scale != highest)):
            raise ConfigError(
                f"source.footage.full_scale: got {stated.full_scale:g}, but the footage holds {held.dtype}"
                + (f" decoded from {held.bits} bits, whose full scale is" if decoded else ", at most")
                + f" {highest:g}"
            )
        if self.frames_per_slot < 1 - 10.0**-_DECIMALS and not stated.repeat:
            raise ConfigError(
                f"source.footage.frame_rate_hz: got {stated.frame_rate_hz:g}, slower than the slots' "
                f"{1 / self.timing.slot_s:g} Hz, so motion inside a frame is lost; use faster footage, or "
                "consent with repeat = true"
            )
        covered = (held.n_frames - stated.first_frame) / self.frames_per_slot + 10.0**-_DECIMALS
        if covered < self.timing.n_slots:
            whole = max(0, int(covered / self.timing.slots_per_frame))
            raise ConfigError(
                f"source.footage: {held.n_frames} frames at {stated.frame_rate_hz:g} Hz from first_frame = "
                f"{stated.first_frame} cover {whole} coded frames, but n_frames = {self.timing.n_frames}; "
                f"{'lower n_frames or ' if whole else ''}record longer"
            )
        stated.weights(held.shape[2])
        _ = self.pixels_per_sample
        stated.radiance(next(held.read(0)), held.where(0))

    def radiance(self, cache: Cache, progress: Progress = silent) -> RadianceVideo:
        """Read every frame once, in order; store each slot's mean radiance in the cache.

        Returns
        -------
        RadianceVideo
            Lazy, W m^-2 sr^-1, one instant a slot; without Monte-Carlo noise, so without halves.
        """
        self.check()
        keys = self.keys()
        missing = [slot for slot, key in enumerate(keys) if key not in cache]
        for done, slot, entry in self._import(missing):
            cache.get(keys[slot], lambda entry=entry: entry)
            progress("footage", done, len(missing))
        return RadianceVideo(
            rows=self.view.rows,
            cols=self.view.cols,
            samples_per_pitch=self.view.samples_per_pitch,
            slot_s=self.timing.slot_s,
            instants_per_slot=1,
            slots_per_segment=1,
            n_slots=self.timing.n_slots,
            load=lambda slot: _still(cache.read(keys[slot])),
            white_w_m2_sr=self.source.white_w_m2_sr,
        )

    def _import(self, slots: list[int]) -> Iterator[tuple[int, int, Arrays]]:
        """Mean radiance of each slot, and the shares that its frames lost; one frame at a time in memory."""
        if not slots:
            return
        rows, cols = self._fit
        first, _ = self.frames_of(slots[0])
        incoming = enumerate(self.recording.read(first), first)
        at, light = -1, RecordedLight(np.zeros(0), 0, 0)
        for done, slot in enumerate(slots, 1):
            first, weights = self.frames_of(slot)
            mean, lost = np.zeros(self.recording.shape[:2]), np.zeros(2)
            for frame, weight in enumerate(weights, first):
                while at < frame:
                    at, values = next(incoming)
                    if at == frame:
                        light = self.source.radiance(values, self.recording.where(frame))
                mean += weight * light.w_m2_sr
                lost += weight * np.array([light.clipped, light.below_black])
            yield done, slot, {"light": ((rows @ mean) @ cols.T).astype(np.float32), "lost": lost}

    def keys(self) -> list[str]:
        """Cache keys of the slots: hashes of files, statements, the grid, and this code."""
        stated = self.source.model_dump(mode="json", exclude={"path", "white_w_m2_sr"})
        same = [stated, self.view.rows, self.view.cols, self.timing.slot_s, hash_files(CODE)]
        files = self.recording.files
        keys: list[str] = []
        for slot in range(self.timing.n_slots):
            first, weights = self.frames_of(slot)
            used = files if len(files) == 1 else files[first : first + len(weights)]
            content = [content_hash(file) for file in used]
            keys.append(hash_of("footage", same, slot, first, content))
        return keys

    def description(self, cache: Cache | None = None) -> str:
        """Describe the truth for a report; with a filled cache also the loss of the recording."""
        held, stated = self.recording, self.source
        rows, cols, channels = held.shape
        parts = [
            f"{held.n_frames} frames of {rows} x {cols} pixels at {stated.frame_rate_hz:g} Hz",
            f"{held.dtype} of {held.bits} bits, {channels} channel{'s' if channels > 1 else ''}",
            f"{stated.linearisation}",
            f"each frame the mean over its period, {self.frames_per_slot:.4g} of them a slot",
            f"fit '{stated.fit}', {self.pixels_per_sample:.4g} footage pixels along a fine sample",
        ]
        if self.pixels_per_sample < 1:
            parts.append("coarser than the fine grid: no detail below its own pixels")
        if self.frames_per_slot < 1:
            parts.append("slower than the slots: frames repeat")
        keys = self.keys() if cache else []
        if cache and all(key in cache for key in keys):
            clipped, below = np.mean([np.array(cache.read(key)["lost"]) for key in keys], axis=0)
            parts.append(f"{clipped:.3%} of pixels at full scale, {below:.3%} of values below black")
        return "; ".join(parts) + ". No Monte-Carlo noise, and no ceiling: no second half."


def open_footage(source: FootageSource, view: View, timing: Timing) -> FootageTruth:
    """Find a recording's files and check its first frame; the rest is checked during reading."""
    found = open_recording(Path(source.path).expanduser(), key=source.key, axes=source.axes)
    return FootageTruth(source, found, view, timing)


def _still(entry: Arrays) -> Segment:
    image = np.asarray(entry["light"])
    return Segment(image, image, (), 1)
