"""The objective applied to a video: lazy, linear, negative light kept."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from optsim.forward.integrate import cell_means
from optsim.forward.psf import Blur, blur_block, extend, make_blur
from optsim.optics.objective import Objective
from optsim.quantities import Block, Doubles, Floats, IrradianceVideo, RadianceVideo, Segment


def form_image(
    objective: Objective, radiance: RadianceVideo, pitch_m: float, kept_segments: int
) -> IrradianceVideo:
    """Irradiance on the modulator: blur, cos^4, radiance to irradiance, veiling glare.

    The glare of moving blocks is spread over the whole field as the straight line in time that fits it
    best within a segment; what deviates from the line is dropped (far below the glare itself).

    Parameters
    ----------
    objective : Objective
        The lens.
    radiance : RadianceVideo
        The scene.
    pitch_m : float
        Panel pitch, m.
    kept_segments : int
        Segments kept for the next use.

    Returns
    -------
    IrradianceVideo
        On the same grid; nothing is computed until a segment is asked for.
    """
    shape = (radiance.rows, radiance.cols)
    cell_m = pitch_m / radiance.samples_per_pitch
    kernel, block_kernel = objective.kernel(cell_m), objective.block_kernel(cell_m)
    reach = kernel.shape[0] // 2
    blur = make_blur(kernel, (shape[0] + 2 * reach, shape[1] + 2 * reach))
    relative = objective.shading(*shape, cell_m)
    factor = relative * objective.irradiance_per_radiance
    keys: list[tuple[Floats, Doubles]] = []

    def key_image(image: Floats) -> Doubles:
        """Image of a key, remembered: a segment starts with the key that the last one stopped with."""
        for seen, result in keys:
            if seen is image or np.array_equal(seen, image):
                return result
        result = _sharp_to_blurred(image, blur, reach) * factor
        keys.append((image, result))
        del keys[:-2]
        return result

    def load(index: int) -> Segment:
        segment = radiance.load(index)
        start = key_image(segment.start)
        stop = key_image(segment.stop)
        blocks = [_shaded(blur_block(b, block_kernel, shape), factor) for b in segment.blocks]
        return _with_glare(start, stop, blocks, segment.n_instants, objective.glare_share)

    return IrradianceVideo(
        rows=radiance.rows,
        cols=radiance.cols,
        samples_per_pitch=radiance.samples_per_pitch,
        slot_s=radiance.slot_s,
        instants_per_slot=radiance.instants_per_slot,
        slots_per_segment=radiance.slots_per_segment,
        n_slots=radiance.n_slots,
        load=lru_cache(maxsize=kept_segments)(load),
        shading=cell_means(relative.astype(np.float32), radiance.samples_per_pitch).astype(np.float32),
    )


def _sharp_to_blurred(image: Floats, blur: Blur, reach: int) -> Doubles:
    rows, cols = image.shape
    return blur.apply(extend(image, reach))[reach : reach + rows, reach : reach + cols]


def _shaded(block: Block, factor: Doubles) -> Block:
    _, height, width = block.excess.shape
    part = factor[block.row : block.row + height, block.col : block.col + width]
    return Block(block.row, block.col, (block.excess * part).astype(np.float32))


def _with_glare(start: Doubles, stop: Doubles, blocks: list[Block], n_instants: int, share: float) -> Segment:
    """Spread a share of the light evenly over the field, and make the segment."""
    flux = np.zeros(n_instants)
    for block in blocks:
        flux += block.excess.sum(axis=(1, 2), dtype=np.float64) / start.size
    at_start, at_stop = _line(flux)
    early = ((1 - share) * start + share * (start.mean() + at_start)).astype(np.float32)
    still = stop is start and at_start == at_stop
    late = early if still else ((1 - share) * stop + share * (stop.mean() + at_stop)).astype(np.float32)
    kept = [Block(b.row, b.col, b.excess * np.float32(1 - share)) for b in blocks]
    return Segment(early, late, tuple(kept), n_instants)


def _line(series: Doubles) -> tuple[float, float]:
    """Return the ends of the least-squares line through values at the middles of n instants."""
    n = series.size
    if n == 1:
        return float(series[0]), float(series[0])
    a = (np.arange(n) + 0.5) / n - 0.5
    slope = float(a @ series / (a @ a))
    mean = float(series.mean())
    return mean - slope / 2, mean + slope / 2
