"""The objective applied to a lazy video: scene radiance -> irradiance on the modulator.

It is linear, and negative Monte-Carlo light is kept; it makes no negative light itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from optsim.camera.parts.objective import Objective
from optsim.core.compiled import FEW, compiled
from optsim.core.quantities import Block, Doubles, Floats, IrradianceVideo, RadianceVideo, Segment
from optsim.core.threads import in_bands
from optsim.optics.field_blur import FieldBlur, FieldPsf, reversed_psf, varying_blur
from optsim.optics.fringing import fine_image
from optsim.optics.integrate import cell_means
from optsim.optics.moving_blur import blur_moving
from optsim.optics.pixel_splines import draw_row, splines
from optsim.optics.psf import Blur, extend, make_blur
from optsim.optics.psf_tails import Ring, cut_softly, far_light, keep_above_zero, make_tails, moving_ends
from optsim.optics.radiometry import MONO_WAVELENGTH_M


def form_image(
    objective: Objective,
    radiance: RadianceVideo,
    pitch_m: float,
    kept_segments: int,
    wavelength_m: float = MONO_WAVELENGTH_M,
) -> IrradianceVideo:
    """Irradiance on the modulator: blur, cos^4, radiance to irradiance, veiling glare.

    PSF tails and veiling glare see moving light as its best straight line in time within a segment. The
    deviation from the line is dropped (far below the tails and the glare). With a ``moving_tail_share`` of 0
    every instant is imaged like a still picture.

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
    wavelength_m : float
        Wavelength of the light, m.

    Returns
    -------
    IrradianceVideo
        On the same grid; a segment is computed when it is read.
    """
    shape = (radiance.rows, radiance.cols)
    pitch = radiance.samples_per_pitch
    cell_m = pitch_m / pitch
    f_number = objective.working_f_number
    psf = objective.psf(f_number, cell_m, shape, 0.0, wavelength_m)
    moving_share = objective.moving_tail_share
    core_half = (
        objective.half_width(f_number, cell_m, moving_share, wavelength_m) if moving_share else psf.half
    )
    blurs = _blurs(psf, core_half, pitch, shape)
    relative = objective.shading(*shape, cell_m)
    factor = relative * objective.irradiance_per_radiance
    seen_keys: list[tuple[Floats, Doubles]] = []

    def still(image: Floats) -> Doubles:
        return blurs.collected(image) * factor

    def key_image(image: Floats) -> Doubles:
        """Image of a key, remembered: a segment starts with the last one's final key."""
        for seen, result in seen_keys:
            if seen is image or np.array_equal(seen, image):
                return result
        result = still(image)
        seen_keys.append((image, result))
        del seen_keys[:-2]
        return result

    share = objective.glare_share
    near = ((1 - share) * factor).astype(np.float32)

    def load(index: int) -> Segment:
        segment = radiance.load(index)
        keys = (key_image(segment.start), key_image(segment.stop))
        if not segment.blocks or not moving_share:
            early = _with_own_glare(keys[0], share)
            late = early if keys[0] is keys[1] else _with_own_glare(keys[1], share)
            return Segment(early, late, _each_instant(segment, still, share), segment.n_instants)
        moving = moving_ends(segment)
        fluxes = [
            float(key.mean()) + float(np.einsum("yx,yx->", line, factor)) / key.size
            for key, line in zip(keys, moving, strict=True)
        ]
        if not blurs.tails:
            ends = [_with_glare(key, flux, share) for key, flux in zip(keys, fluxes, strict=True)]
        else:
            far = far_light(moving, blurs.tails, pitch)
            ends = [
                _with_far_light(key, wide, near, flux * share, 1 - share)
                for key, wide, flux in zip(keys, far, fluxes, strict=True)
            ]
        # A negative base is not light but the difference of two lights.
        if min(end.min() for end in ends) < 0 <= min(segment.start.min(), segment.stop.min()):
            keep_above_zero(ends[0], ends[1])
        blocks = blur_moving(segment.blocks, blurs.core, pitch, near)
        return Segment(ends[0], ends[1], blocks, segment.n_instants)

    return IrradianceVideo(
        rows=radiance.rows,
        cols=radiance.cols,
        samples_per_pitch=pitch,
        slot_s=radiance.slot_s,
        instants_per_slot=radiance.instants_per_slot,
        slots_per_segment=radiance.slots_per_segment,
        n_slots=radiance.n_slots,
        load=lru_cache(maxsize=kept_segments)(load),
        shading=cell_means(relative.astype(np.float32), pitch).astype(np.float32),
    )


@dataclass(frozen=True, eq=False)
class _Blurs:
    """A PSF prepared for a field, rotated by half a turn: image points collect with weights of sum one."""

    # Radiance is constant along a ray.

    core: FieldPsf  # Applied to moving light in each instant.
    tails: tuple[Ring, ...]  # Applied to the straight line in time.
    reach: int  # Half width of the whole PSF.
    common: Blur  # The same everywhere, on the field and a margin of ``reach``.
    varying: FieldBlur | None  # The part that varies, on the field.

    def collected(self, image: Floats) -> Doubles:
        """Image of a picture that continues beyond the panel's edge."""
        reach = self.reach
        wide = extend(image, reach).astype(np.float64)
        light = self.common.adjoint(wide)[reach : reach + len(image), reach : reach + image.shape[1]]
        if self.varying is None:
            return light
        rest = reach - self.varying.half
        return light + self.varying.collect(wide[rest : len(wide) - rest, rest : wide.shape[1] - rest])


# Cached, since a camera takes many videos; only two, since each is as large as many pictures.
@lru_cache(maxsize=2)
def _blurs(psf: FieldPsf, core_half: int, pitch: int, shape: tuple[int, int]) -> _Blurs:
    turned = reversed_psf(psf)
    core, tails = cut_softly(turned, core_half)
    wide = (shape[0] + 2 * psf.half, shape[1] + 2 * psf.half)
    return _Blurs(
        core,
        make_tails(tails, pitch, shape),
        psf.half,
        make_blur(turned.common, wide, wraps=True),
        varying_blur(turned.cores, shape) if psf.cores.size else None,
    )


def _each_instant(
    segment: Segment, still: Callable[[Floats], Doubles], glare_share: float
) -> tuple[Block, ...]:
    """Image moving light instant by instant, each as a picture of the whole field."""
    if not segment.blocks:
        return ()
    dark = np.zeros_like(segment.start)
    moving = Segment(dark, dark, segment.blocks, segment.n_instants)
    excess = np.zeros((segment.n_instants, *dark.shape), np.float32)
    for t in range(segment.n_instants):
        if any(block.excess[t].any() for block in segment.blocks):
            excess[t] = _with_own_glare(still(moving.instant(t)), glare_share)
    return (Block(0, 0, excess),)


def _with_own_glare(image: Doubles, share: float) -> Floats:
    return _with_glare(image, float(image.mean()), share)


def _with_glare(image: Doubles, flux: float, share: float) -> Floats:
    """Spread a share of the light evenly over the field."""
    return ((1 - share) * image + share * flux).astype(np.float32)


def _with_far_light(key: Doubles, far: Doubles, factor: Floats, evenly: float, kept: float) -> Floats:
    """Keep a share of a key's image; add glare, and the light of PSF tails as splines of panel pixels."""
    shares = splines(len(key) // len(far))
    if key.size < FEW:
        return (kept * key + factor * fine_image(far, shares) + evenly).astype(np.float32)
    result = np.empty(key.shape, np.float32)
    # Beyond the panel's edge the nearest pixel's value is used.
    around = np.pad(far, 1, mode="edge")
    in_bands(len(key), lambda a, b: _add_far(key, around, shares, factor, evenly, kept, a, b, result))
    return result


@compiled()
def _add_far(
    key: Doubles,
    around: Doubles,
    shares: Doubles,
    factor: Floats,
    evenly: float,
    kept: float,
    top: int,
    bottom: int,
    out: Floats,
) -> None:
    pitch, cols = len(shares), around.shape[1]
    line, drawn = np.empty(cols), np.empty((cols - 2) * pitch)
    for y in range(top, bottom):
        v = y // pitch
        before, own, after = shares[y % pitch]
        for u in range(cols):
            line[u] = before * around[v, u] + own * around[v + 1, u] + after * around[v + 2, u]
        draw_row(line, shares, drawn)
        for x in range(len(drawn)):
            out[y, x] = kept * key[y, x] + factor[y, x] * drawn[x] + evenly
