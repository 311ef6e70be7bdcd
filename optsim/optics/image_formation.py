# pyright: reportUntypedFunctionDecorator=false, reportMissingTypeStubs=false
"""The objective applied to a video: lazy, linear, negative light kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from optsim.forward.bands import in_bands
from optsim.forward.compiled import FEW, compiled
from optsim.forward.field_blur import FieldBlur, FieldPsf, reversed_psf, varying_blur
from optsim.forward.integrate import cell_means
from optsim.forward.moving_blur import blur_moving
from optsim.forward.psf import Blur, extend, make_blur
from optsim.forward.radiometry import MONO_WAVELENGTH_M
from optsim.forward.wings import Ring, far_light, make_wings, moving_ends
from optsim.optics.objective import CORE_SHARE, Objective
from optsim.quantities import Doubles, Floats, IrradianceVideo, RadianceVideo, Segment


def form_image(
    objective: Objective,
    radiance: RadianceVideo,
    pitch_m: float,
    kept_segments: int,
    wavelength_m: float = MONO_WAVELENGTH_M,
) -> IrradianceVideo:
    """Irradiance on the modulator: blur, cos^4, radiance to irradiance, veiling glare.

    The far wings of the PSF and the veiling glare get moving light as the straight line in time that fits
    it best within a segment; what deviates from the line is dropped (far below the wings and the glare).

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
        Of the light, m.

    Returns
    -------
    IrradianceVideo
        On the same grid; nothing is computed until a segment is asked for.
    """
    shape = (radiance.rows, radiance.cols)
    pitch = radiance.samples_per_pitch
    cell_m = pitch_m / pitch
    f_number = objective.working_f_number
    psf = objective.psf(f_number, cell_m, shape, 0.0, wavelength_m)
    blurs = _blurs(psf, objective.half_width(f_number, cell_m, CORE_SHARE, wavelength_m), pitch, shape)
    relative = objective.shading(*shape, cell_m)
    factor = relative * objective.irradiance_per_radiance
    seen_keys: list[tuple[Floats, Doubles]] = []

    def key_image(image: Floats) -> Doubles:
        """Image of a key, remembered: a segment starts with the key that the last one stopped with."""
        for seen, result in seen_keys:
            if seen is image or np.array_equal(seen, image):
                return result
        result = blurs.collected(image) * factor
        seen_keys.append((image, result))
        del seen_keys[:-2]
        return result

    share = objective.glare_share
    near = ((1 - share) * factor).astype(np.float32)

    def load(index: int) -> Segment:
        segment = radiance.load(index)
        keys = (key_image(segment.start), key_image(segment.stop))
        if not segment.blocks:
            early = _with_glare(keys[0], keys[0].mean(), share)
            late = early if keys[0] is keys[1] else _with_glare(keys[1], keys[1].mean(), share)
            return Segment(early, late, (), segment.n_instants)
        moving = moving_ends(segment)
        fluxes = [
            float(key.mean()) + float(np.einsum("yx,yx->", line, factor)) / key.size
            for key, line in zip(keys, moving, strict=True)
        ]
        if not blurs.wings:
            ends = [_with_glare(key, flux, share) for key, flux in zip(keys, fluxes, strict=True)]
        else:
            far = far_light(moving, blurs.wings, pitch)
            ends = [
                _with_far_light(key, wide, near, flux * share, 1 - share)
                for key, wide, flux in zip(keys, far, fluxes, strict=True)
            ]
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
    """A PSF made ready for a field, turned by half a turn.

    Along a ray radiance stays, so a point of the image collects from around with weights that sum to one.

    Parameters
    ----------
    core : FieldPsf
        What moving light gets in each instant.
    wings : tuple of Ring
        What it gets as a straight line in time.
    reach : int
        Half width of the whole.
    common : Blur
        Part that is the same everywhere, on the field and ``reach`` around it.
    varying : FieldBlur or None
        The other part, on the field.
    """

    core: FieldPsf
    wings: tuple[Ring, ...]
    reach: int
    common: Blur
    varying: FieldBlur | None

    def collected(self, image: Floats) -> Doubles:
        """Image of a picture that does not end where the panel does."""
        reach = self.reach
        wide = extend(image, reach).astype(np.float64)
        light = self.common.adjoint(wide)[reach : reach + len(image), reach : reach + image.shape[1]]
        if self.varying is None:
            return light
        rest = reach - self.varying.half
        return light + self.varying.collect(wide[rest : len(wide) - rest, rest : wide.shape[1] - rest])


# Kept, since a camera takes many videos; two, since they are as large as many pictures.
@lru_cache(maxsize=2)
def _blurs(psf: FieldPsf, core_half: int, pitch: int, shape: tuple[int, int]) -> _Blurs:
    turned = reversed_psf(psf)
    core = turned.middle(core_half)
    wide = (shape[0] + 2 * psf.half, shape[1] + 2 * psf.half)
    return _Blurs(
        core,
        make_wings(turned.kernel, core.half, pitch, shape),
        psf.half,
        make_blur(turned.common, wide, wraps=True),
        varying_blur(turned.cores, shape) if psf.cores.size else None,
    )


def _with_glare(image: Doubles, flux: float, share: float) -> Floats:
    """Take a share of the light away and spread as much of the mean light evenly over the field."""
    return ((1 - share) * image + share * flux).astype(np.float32)


def _with_far_light(key: Doubles, far: Doubles, factor: Floats, evenly: float, kept: float) -> Floats:
    """Keep a share of a key's image; add far light, given on panel pixels, and glare."""
    if key.size < FEW:
        pitch = len(key) // len(far)
        light = far.repeat(pitch, axis=0).repeat(pitch, axis=1)
        return (kept * key + factor * light + evenly).astype(np.float32)
    result = np.empty(key.shape, np.float32)
    in_bands(len(key), lambda a, b: _add_far(key, far, factor, evenly, kept, a, b, result))
    return result


@compiled()
def _add_far(
    key: Doubles, far: Doubles, factor: Floats, evenly: float, kept: float, top: int, bottom: int, out: Floats
) -> None:
    pitch = key.shape[0] // far.shape[0]
    for y in range(top, bottom):
        for u in range(far.shape[1]):
            light = far[y // pitch, u]
            for x in range(u * pitch, (u + 1) * pitch):
                out[y, x] = kept * key[y, x] + factor[y, x] * light + evenly
