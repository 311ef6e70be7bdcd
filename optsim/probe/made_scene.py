# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""What probes look at, and what their panels show.

Reflectances over a decade and a half, something that moves, and, where the experiment has a bright light in
the picture, one. One half of the panel shows a random code, the other an exposure mosaic.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optsim.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.quantities import Block, Bytes, ExposureCode, Floats, RadianceVideo, Segment, made_radiance
from optsim.scene import BrightLight

# Declared white over the interior's bright places: about that of window_room, whose interior is lit by its
# window alone; in brighter rooms a lamp in the picture is then taken for too bright.
WHITE_OVER_INTERIOR = 40.0
_WAY_PX = 30  # fine samples that the patch moves
_PARTS = (4, 5, 3, 2, 1)  # of a frame, of which it moves in one
# Slots that the four densities of the mosaic are open, as shares of a frame.
_DENSITIES = (1 / 36, 1 / 12, 11 / 36, 1.0)


def made_scene(camera: CodedCamera, white_w_m2_sr: float, bright: BrightLight | None) -> RadianceVideo:
    """Make a scene of which a camera sees a frame.

    Parameters
    ----------
    camera : CodedCamera
        Small, as the cost is that of its frame.
    white_w_m2_sr : float
        Radiance of the brightest reflectance.
    bright : BrightLight or None
        Brightest light in the picture.
    """
    view, n_slots = camera.view, camera.slots_per_frame
    rng = np.random.default_rng(1288)
    base = white_w_m2_sr * _reflectances(rng, view.rows, view.cols)
    if bright is not None:
        side = np.sqrt(bright.share)
        height, width = max(1, round(view.rows * side)), max(1, round(view.cols * side))
        # A lamp smaller than a sample brings as much light by a less bright one.
        over = bright.over_white * bright.share * view.rows * view.cols / (height * width)
        # Its left part is in the way of what moves.
        row, col = (view.rows - height) // 3, (view.cols - width) // 4
        base[row : row + height, col : col + width] = over * WHITE_OVER_INTERIOR * float(base.mean())
    parts = next(n for n in _PARTS if n_slots % n == 0)
    n = n_slots // parts
    height, width = view.rows // 3, view.cols // 3
    # A panel of a few pixels leaves less way to go.
    reach = min(_WAY_PX, view.cols // 3)
    row, col = view.rows * 5 // 12, max(0, (view.cols - width - reach) // 2)
    width = min(width, view.cols - col - reach)
    patch = white_w_m2_sr * _reflectances(rng, height, width)

    def picture(share: float) -> Floats:
        """Patch a share of its way along."""
        left, seen = col + round(share * reach), base.copy()
        seen[row : row + height, left : left + width] = patch
        return seen

    start, stop = picture(0.0), picture(1.0)
    # It stands, moves for a part of the frame, and stands: to move in all parts takes as many times as long.
    still = Segment(start, start, (), n), Segment(stop, stop, (), n)
    lines = Segment(start, stop, (), n)
    window = np.s_[row : row + height, col : col + width + reach]
    excess = np.stack([picture((t + 0.5) / n)[window] - lines.instant(t)[window] for t in range(n)])
    moving = replace(lines, blocks=(Block(row, col, excess),))
    segments = [still[0], moving, *[still[1]] * (parts - 2)] if parts > 1 else [moving]
    return made_radiance(
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


def made_code(camera: CodedCamera, radiance: RadianceVideo) -> ExposureCode:
    """Make a code that has exposures of most kinds: all that moves is on either side of it."""
    n, rows, cols = camera.slots_per_frame, camera.panel_rows, camera.panel_cols
    random: Bytes = (np.random.default_rng(36).random((n, rows, cols)) < 0.5).astype(np.uint8) * np.uint8(255)
    tile = np.array(_DENSITIES).reshape(2, 2)
    opened = np.tile(tile, (-(-rows // 2), -(-cols // 2)))[:rows, :cols] * n
    static = np.arange(cols) < cols // 2
    mosaic = (np.arange(n)[:, None, None] < np.rint(opened)).astype(np.uint8) * np.uint8(255)
    levels = np.where(static, mosaic, random)
    # Before bright light open, as in normal photography, which lets most of it stray; random while it moves.
    bright = radiance.load(0).start > radiance.white_w_m2_sr
    lit = bright.reshape(rows, SAMPLES_PER_PITCH, cols, SAMPLES_PER_PITCH).any(axis=(1, 3))
    levels[:, lit] = 255
    moves = slice(radiance.slots_per_segment, 2 * radiance.slots_per_segment)
    part = moves if radiance.n_segments > 1 else slice(None)
    levels[part, lit] = random[part, lit]
    return ExposureCode(levels, np.broadcast_to(~static, (rows, cols)).copy())
