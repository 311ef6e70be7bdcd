"""Time, field of view, and light as a lazy video: a segment is computed when it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities.arrays import Bools, Floats, checked


@dataclass(frozen=True)
class Timing:
    """When truth instants, slots and coded frames happen.

    Parameters
    ----------
    slot_s : float
        Duration of an LCoS slot, s.
    slots_per_frame : int
        Slots in a coded frame's period.
    n_frames : int
        Coded frames.
    """

    slot_s: float
    slots_per_frame: int
    n_frames: int

    @property
    def n_slots(self) -> int:
        """Slots in the whole experiment."""
        return self.slots_per_frame * self.n_frames


@dataclass(frozen=True)
class View:
    """Field of view of the fine grid, through a pinhole or a thin lens before it.

    Parameters
    ----------
    rows, cols : int
        Fine samples.
    samples_per_pitch : int
        Fine samples per panel pixel, along each axis.
    tan_half_width : float
        Tangent of half the horizontal field of view without distortion: half the image width over the focal
        length.
    aperture_m : float
        Diameter of the thin lens, m; 0 is a pinhole.
    focus_m : float or None
        Depth in focus along the axis, m; None is the distance of the scene camera's target. It has no effect
        on a pinhole.
    defocus_per_m : float
        Focus error against ``focus_m``, towards the camera, 1/m.
    distortion : float
        Relative radial displacement at the grid's corner; it grows with the square of the distance from the
        centre. Negative is a barrel (:mod:`optsim.optics.lens`).
    """

    rows: int
    cols: int
    samples_per_pitch: int
    tan_half_width: float
    aperture_m: float = 0.0
    focus_m: float | None = None
    defocus_per_m: float = 0.0
    distortion: float = 0.0


@dataclass(frozen=True, eq=False)
class Block:
    """Excess over a segment's interpolated base in a rectangle: the light of what moves there.

    Parameters
    ----------
    row, col : int
        First fine row and column of the rectangle.
    excess : ndarray of shape (t, y, x), float32
        Mean over each instant of (signal - interpolated base), in the unit of the video; may be negative.
    """

    row: int
    col: int
    excess: Floats

    def __post_init__(self) -> None:
        checked(
            "block",
            self.excess,
            axes=("t", "y", "x"),
            dtype=np.float32,
            unit="of its video",
            nonnegative=False,
        )


@dataclass(frozen=True, eq=False)
class Segment:
    """A stretch of a video between two key instants: a linear base plus moving blocks.

    During instant i (counted from 0 inside the segment, of n) the signal is ``(1 - a) start + a stop + sum of
    blocks`` with ``a = (i + 0.5) / n``.

    Parameters
    ----------
    start, stop : ndarray of shape (y, x), float32
        Signal at the two ends where nothing moves, in the unit of the video.
    blocks : tuple of Block
        Excess where something moves; the excesses of overlapping blocks add.
    n_instants : int
        Instants in the segment.
    """

    start: Floats
    stop: Floats
    blocks: tuple[Block, ...]
    n_instants: int

    def __post_init__(self) -> None:
        for name, image in (("segment start", self.start), ("segment stop", self.stop)):
            checked(name, image, axes=("y", "x"), dtype=np.float32, unit="of its video", nonnegative=False)
        rows, cols = self.start.shape
        for block in self.blocks:
            n, height, width = block.excess.shape
            inside = (
                block.row >= 0 and block.col >= 0 and block.row + height <= rows and block.col + width <= cols
            )
            if n != self.n_instants or not inside:
                raise ValueCheckError(
                    f"block of shape {block.excess.shape} at ({block.row}, {block.col}) does not fit a "
                    f"segment of {self.n_instants} instants and {rows} x {cols} samples"
                )

    def instant(self, index: int) -> Floats:
        """Signal during one instant: array of shape (y, x), float32."""
        a = np.float32((index + 0.5) / self.n_instants)
        frame: Floats = np.add((1 - a) * self.start, a * self.stop, dtype=np.float32)
        for block in self.blocks:
            _, height, width = block.excess.shape
            frame[block.row : block.row + height, block.col : block.col + width] += block.excess[index]
        return frame


@dataclass(frozen=True, eq=False)
class Video:
    """A lazy light video on the fine grid: a segment is computed when it is read.

    Parameters
    ----------
    rows, cols : int
        Fine samples.
    samples_per_pitch : int
        Fine samples per panel pixel, along each axis.
    slot_s : float
        Duration of a slot, s.
    instants_per_slot : int
        Truth instants per slot.
    slots_per_segment : int
        Slots between two key instants; divides the slots of a coded frame.
    n_slots : int
        Slots in the whole video.
    load : callable
        Segment index -> Segment. Called at every use, so it must be cheap or cached.
    """

    UNIT: ClassVar[str] = "of the light"
    rows: int
    cols: int
    samples_per_pitch: int
    slot_s: float
    instants_per_slot: int
    slots_per_segment: int
    n_slots: int
    load: Callable[[int], Segment] = field(repr=False)

    @classmethod
    def on_view(
        cls,
        view: View,
        slot_s: float,
        load: Callable[[int], Segment],
        *,
        slots_per_segment: int,
        n_slots: int,
        instants_per_slot: int = 1,
        **others: Any,
    ) -> Self:
        """Make a video of light that isn't rendered, on a camera's view; arguments as of the class."""
        grid = view.rows, view.cols, view.samples_per_pitch
        return cls(*grid, slot_s, instants_per_slot, slots_per_segment, n_slots, load, **others)

    def __post_init__(self) -> None:
        if self.n_slots % self.slots_per_segment:
            raise ValueCheckError(
                f"a video of {self.n_slots} slots cannot have segments of {self.slots_per_segment}"
            )
        if self.rows % self.samples_per_pitch or self.cols % self.samples_per_pitch:
            raise ValueCheckError(
                f"{self.rows} x {self.cols} fine samples are not whole panel pixels of "
                f"{self.samples_per_pitch} x {self.samples_per_pitch}"
            )

    @property
    def n_segments(self) -> int:
        """Number of segments."""
        return self.n_slots // self.slots_per_segment

    @property
    def panel_shape(self) -> tuple[int, int]:
        """Panel pixels (v, u) that the fine grid covers."""
        return self.rows // self.samples_per_pitch, self.cols // self.samples_per_pitch

    def segments(self, first_slot: int, last_slot: int) -> Iterator[tuple[int, Segment]]:
        """Segments of slots first_slot .. last_slot - 1, each with its first slot."""
        n = self.slots_per_segment
        if first_slot % n or last_slot % n or not 0 <= first_slot <= last_slot <= self.n_slots:
            raise ValueCheckError(
                f"slots {first_slot}..{last_slot} are not whole segments of {n} slots "
                f"in a video of {self.n_slots}"
            )
        for index in range(first_slot // n, last_slot // n):
            segment = self.load(index)
            if segment.n_instants != n * self.instants_per_slot:
                raise ValueCheckError(
                    f"segment {index}: got {segment.n_instants} instants, expected {n} slots of "
                    f"{self.instants_per_slot}"
                )
            yield index * n, segment


@dataclass(frozen=True, eq=False)
class RadianceVideo(Video):
    """Scene radiance toward the objective in the band, W m^-2 sr^-1 (mono: all of it at 550 nm).

    Parameters
    ----------
    white_w_m2_sr : float
        The scene's declared white: the peak of every PSNR (PHYSICS: never the maximum found).
    outside : ndarray of shape (y, x), bool
        Samples that see the bright outside directly when nothing moves.
    half_difference : RadianceVideo or None
        (half A - half B) / 2 of two independent renders, on the same grid. Its variance is the noise variance
        of this video. None for footage without Monte-Carlo noise.
    """

    UNIT: ClassVar[str] = "W m^-2 sr^-1"
    white_w_m2_sr: float = 1.0
    outside: Bools | None = field(default=None, repr=False)
    half_difference: RadianceVideo | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class IrradianceVideo(Video):
    """Irradiance on the modulator plane, before the first splitter pass, unpolarised-equivalent, W m^-2.

    Parameters
    ----------
    shading : ndarray of shape (v, u), float32
        The objective's relative flat-field shading at the panel pixels, 1 on axis.
    """

    UNIT: ClassVar[str] = "W m^-2"
    shading: Floats = field(default_factory=lambda: np.ones((1, 1), np.float32), repr=False)
