"""Synthetic scene of a probe: reflectances over a decade and a half, a moving patch, and a bright light.

It has a bright light only where the experiment has one in the picture.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.core.quantities import Block, Floats, RadianceVideo, Segment
from optsim.scene import BrightLight

# Declared white over the interior's bright places: about that of window_room, lit by its window alone. In
# brighter rooms it overestimates a lamp in the picture.
WHITE_OVER_INTERIOR = 40.0
_WAY_PX = 30  # fine samples that the patch moves
# Parts of a frame; the patch moves in the first. With 36 slots it is as long as the longest segment of a
# rendered video.
_PARTS = (2, 3, 5, 1)


def made_scene(camera: CodedCamera, white_w_m2_sr: float, bright: BrightLight | None) -> RadianceVideo:
    """Make a scene that lasts for one frame of a camera."""
    view, n_slots = camera.view, camera.slots_per_frame
    rng = np.random.default_rng(1288)
    base = white_w_m2_sr * _reflectances(rng, view.rows, view.cols)
    if bright is not None:
        side = np.sqrt(bright.share)
        height, width = max(1, round(view.rows * side)), max(1, round(view.cols * side))
        # A lamp smaller than a sample becomes a dimmer one with the same light.
        over = bright.over_white * bright.share * view.rows * view.cols / (height * width)
        # Its left part lies in the path of the moving patch.
        row, col = (view.rows - height) // 3, (view.cols - width) // 4
        base[row : row + height, col : col + width] = over * WHITE_OVER_INTERIOR * float(base.mean())
    parts = next(n for n in _PARTS if n_slots % n == 0)
    n = n_slots // parts
    height, width = view.rows // 3, view.cols // 3
    # On a panel of a few pixels the path is shorter.
    reach = min(_WAY_PX, view.cols // 3)
    row, col = view.rows * 5 // 12, max(0, (view.cols - width - reach) // 2)
    width = min(width, view.cols - col - reach)
    patch = white_w_m2_sr * _reflectances(rng, height, width)

    def picture(share: float) -> Floats:
        """Picture with the patch at a share of its path."""
        left, seen = col + round(share * reach), base.copy()
        seen[row : row + height, left : left + width] = patch
        return seen

    start, stop = picture(0.0), picture(1.0)
    # The patch moves in one part of the frame only: motion in all parts would multiply the run time.
    still = Segment(stop, stop, (), n)
    lines = Segment(start, stop, (), n)
    window = np.s_[row : row + height, col : col + width + reach]
    excess = np.stack([picture((t + 0.5) / n)[window] - lines.instant(t)[window] for t in range(n)])
    moving = replace(lines, blocks=(Block(row, col, excess),))
    segments = [moving, *[still] * (parts - 1)]
    return RadianceVideo.on_view(
        view,
        camera.slot_s,
        lambda index: segments[index],
        slots_per_segment=n,
        n_slots=n_slots,
        white_w_m2_sr=white_w_m2_sr,
    )


def _reflectances(rng: np.random.Generator, rows: int, cols: int) -> Floats:
    """Patches of some samples, from 0.03 to 1."""
    coarse = rng.random((-(-rows // 12), -(-cols // 12)), np.float32)
    fine = np.repeat(np.repeat(coarse, 12, 0), 12, 1)[:rows, :cols]
    # A Gaussian of one sample, cut at four of them, mirrored at the border.
    line = np.exp(-(np.arange(-4.0, 5.0) ** 2) / 2)
    for axis in (0, 1):
        wide = np.pad(fine, [(4, 4) if axis == each else (0, 0) for each in (0, 1)], "symmetric")
        windows = np.lib.stride_tricks.sliding_window_view(wide, 9, axis)
        fine = np.asarray(windows @ (line / line.sum()), np.float32)
    return np.asarray(10 ** (fine * 1.5 - 1.5), np.float32)
