# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""The relay from the panel to the CCD: its parameters, geometry and linear operator."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, cast

import numpy as np
from pydantic import Field
from scipy import sparse
from scipy.optimize import fminbound

from optsim.camera.parts.lens import LensGroup
from optsim.core.config import Part
from optsim.optics.aberrations import Wavefront
from optsim.optics.field_blur import FieldPsf, make_field_blur
from optsim.optics.psf import SomeBlur
from optsim.optics.psf_tails import near_half, with_tails
from optsim.optics.radiometry import MONO_WAVELENGTH_M
from optsim.optics.relay import Ghost, RelayGeometry, RelayOperator, overlap_operator

# PSF tails are computed on panel pixels. They begin at this distance from the centre or farther, and have at
# most this share of the light. For the prototype they have 0.4 %, and 0.02 % is misplaced by up to two fine
# cells.
_NEAR_PIXELS, _TAILS_SHARE = 8, 5e-3
_COLOURS_M = 200e-9  # range of lateral colour


class Mount(Part):
    """What holds panel, relay and CCD, and grows with its temperature; without lengths nothing moves.

    Parameters
    ----------
    temperature_c, aligned_c : float
        Temperature, and that at which the camera was aligned.
    expansion_per_k : float
        Linear expansion; by default that of aluminium (CRC Handbook of Chemistry and Physics: 23.1e-6 at 25
        degrees).
    along_m : float
        Length along the axis whose growth moves the CCD away from the sharp image, without what the rest of
        the mount undoes. Negative moves it towards the relay.
    across_y_m, across_x_m : float
        Length across the axis whose growth shifts the panel's image on the CCD.
    scale_per_k : float
        Relative growth of the image, by lenses and distances.
    """

    temperature_c: float = Field(default=25.0, ge=-60, le=100)
    aligned_c: float = Field(default=25.0, ge=-60, le=100)
    expansion_per_k: float = Field(default=23.1e-6, ge=-1e-4, le=1e-4)
    along_m: float = Field(default=0.0, ge=-2, le=2)
    across_y_m: float = Field(default=0.0, ge=-2, le=2)
    across_x_m: float = Field(default=0.0, ge=-2, le=2)
    scale_per_k: float = Field(default=0.0, ge=-1e-3, le=1e-3)

    @property
    def warmer_k(self) -> float:
        """Temperature above that of its alignment."""
        return self.temperature_c - self.aligned_c

    def growth_m(self, length_m: float) -> float:
        """Growth of a length since its alignment."""
        return self.warmer_k * self.expansion_per_k * length_m


class Relay(LensGroup):
    """Lenses that image the panel onto the CCD.

    Parameters
    ----------
    magnification : float
        Magnification from the panel to the CCD, without ``magnification_error``.
    f_number : float
        f-number of the fastest cone that it passes onto the CCD.
    transmission : float
        Share of the light that passes its lenses, all passes together.
    focus : {"paraxial", "centre", "field"}
        Where the CCD stands if ``defocus_m`` is 0: in the sharp image without aberrations, or where pixels
        in the middle of the panel, or all of them on average, spill least light onto others.
    defocus_m : float
        Distance of the CCD from there; positive has a positive wavefront term, like positive field curvature.
        Without diffraction it blurs by the disc of geometrical optics.
    ghost_share : float
        Share of the light reflected back from a face, mirrored through the axis and out of focus.
    ghost_blur_px : float
        Standard deviation of the ghost's blur, panel pixels; no source.
    shift_y_px, shift_x_px : float
        Shift of the panel's image from the centre of the CCD, CCD pixels; positive is down, and to the right.
    rotation_rad : float
        Rotation of the panel's image, rad; positive from the columns' axis x towards the rows' axis y, which
        is clockwise in a picture whose rows go down.
    magnification_error : float
        Relative excess of the image scale over ``magnification``; negative is smaller.
    keystone_y, keystone_x : float
        Relative reduction of the last used row's, or column's, image against the middle one; negative is
        larger.
    distortion : float
        Relative change of the distance from the centre at the corners of the used panel; positive is a
        pincushion, negative a barrel.
    lateral_colour : float
        Relative growth of the image about its centre from 450 nm to 650 nm, linear in wavelength; negative
        shrinks. At 550 nm the scale is ``magnification``.
    mount : Mount
        Its temperature adds to focus, shift and scale.
    """

    magnification: float = Field(gt=0)
    f_number: float = Field(gt=0.5)
    transmission: float = Field(gt=0, le=1)
    focus: Literal["paraxial", "centre", "field"] = "paraxial"
    defocus_m: float = 0.0
    ghost_share: float = Field(default=0.0, ge=0, lt=1)
    ghost_blur_px: float = Field(default=20.0, gt=0, le=200)
    shift_y_px: float = 0.0
    shift_x_px: float = 0.0
    rotation_rad: float = Field(default=0.0, ge=-0.05, le=0.05)
    magnification_error: float = Field(default=0.0, ge=-0.02, le=0.02)
    keystone_y: float = Field(default=0.0, ge=-0.2, le=0.2)
    keystone_x: float = Field(default=0.0, ge=-0.2, le=0.2)
    distortion: float = Field(default=0.0, ge=-0.2, le=0.2)
    lateral_colour: float = Field(default=0.0, ge=-0.02, le=0.02)
    mount: Mount = Mount()

    def image_f_number(self, panel_f_number: float) -> float:
        """f-number of the cone on the CCD: the panel's, demagnified, or the relay's own if that is slower."""
        return max(self.f_number, panel_f_number * self.magnification)

    def accepted_share(self, panel_f_number: float) -> float:
        """Share of the panel's cone that passes the relay's stop, in a uniformly filled cone."""
        return min(1.0, (panel_f_number * self.magnification / self.f_number) ** 2)

    def ccd_defocus_m(
        self, f_number: float, cell_m: float, sides: tuple[int, int], samples_per_pitch: int
    ) -> float:
        """Distance of the CCD from the sharp image without aberrations, m; grid as for the PSF."""
        wavefront, from_focus_m = self.wavefront, self.defocus_m + self.mount.growth_m(self.mount.along_m)
        if self.focus == "paraxial" or wavefront == Wavefront() or not self.diffraction:
            return from_focus_m
        # Before the search, which takes a plain lens group: a message names the relay.
        self._check_window(f_number, cell_m, from_focus_m, MONO_WAVELENGTH_M)
        if self.focus == "centre":
            wavefront = Wavefront(spherical_waves=wavefront.spherical_waves)
        lens = LensGroup(
            aberration_m=self.aberration_m,
            wavefront=wavefront,
            glare_share=0.0,
            tail_share=self.tail_share,
            field_error=1.0,
        )
        # A frozen model is hashable, but its type does not declare it.
        best_m = _least_spill_m(lens, f_number, cell_m, sides, samples_per_pitch)  # pyright: ignore[reportArgumentType]
        return best_m + from_focus_m

    def geometry(
        self,
        cells: tuple[int, int],
        ccd: tuple[int, int],
        cell_px: float,
        ccd_pitch_m: float,
        wavelength_m: float = MONO_WAVELENGTH_M,
    ) -> RelayGeometry:
        """Image of (y, x) panel cells, each ``cell_px`` CCD pixels wide at 550 nm, on a CCD of (y, x)."""
        mount = self.mount
        larger = 1 + self.lateral_colour * (wavelength_m - MONO_WAVELENGTH_M) / _COLOURS_M
        larger *= (1 + self.magnification_error) * (1 + mount.warmer_k * mount.scale_per_k)
        return RelayGeometry(
            rows=cells[0],
            cols=cells[1],
            ccd_rows=ccd[0],
            ccd_cols=ccd[1],
            cell_px=cell_px * larger,
            magnification=self.magnification * larger,
            shift_y_px=self.shift_y_px + mount.growth_m(mount.across_y_m) / ccd_pitch_m,
            shift_x_px=self.shift_x_px + mount.growth_m(mount.across_x_m) / ccd_pitch_m,
            rotation_rad=self.rotation_rad,
            keystone_y=self.keystone_y,
            keystone_x=self.keystone_x,
            distortion=self.distortion,
        )

    def operator(
        self,
        geometry: RelayGeometry,
        panel_f_number: float,
        cell_m: float,
        transmission: float,
        samples_per_pitch: int,
        wavelength_m: float = MONO_WAVELENGTH_M,
    ) -> RelayOperator:
        """Operator from the fine panel grid to the CCD; cached for the same numbers.

        Parameters
        ----------
        geometry : RelayGeometry
            Geometry of the fine grid's image.
        panel_f_number : float
            f-number of the cone that leaves the panel.
        cell_m : float
            Side of a fine cell on the panel, m.
        transmission : float
            Transmission of all that the operator stands for; at most 1.
        samples_per_pitch : int
            Fine cells to a panel pixel.
        wavelength_m : float
            Wavelength of the light, m.
        """
        f_number = self.image_f_number(panel_f_number)
        shape = (geometry.rows, geometry.cols)
        image_m = cell_m * self.magnification
        defocus_m = self.ccd_defocus_m(f_number, image_m, shape, samples_per_pitch)
        psf = self.psf(f_number, image_m, shape, defocus_m, wavelength_m)
        ghost = None
        if self.ghost_share:
            ghost = Ghost(self.ghost_share, self.ghost_blur_px, samples_per_pitch)
        return RelayOperator(
            _blur(psf, shape, samples_per_pitch),
            _overlap(geometry, transmission),
            self.glare_share,
            (geometry.ccd_rows, geometry.ccd_cols),
            ghost,
        )


@lru_cache(maxsize=16)
def _least_spill_m(
    lens: LensGroup, f_number: float, cell_m: float, sides: tuple[int, int], pitch: int
) -> float:
    """Defocus at which a panel pixel spills least light onto others, by its mean PSF over the field."""
    # A wave at the pupil's rim.
    wave_m = 8 * f_number**2 * MONO_WAVELENGTH_M

    def spill(waves: float) -> float:
        kernel = lens.psf(f_number, cell_m, sides, waves * wave_m).kernel
        apart = np.abs(np.arange(len(kernel)) - len(kernel) // 2)
        # CCD pixels as large as a fine cell lie anywhere on the panel's image.
        inside = np.clip((pitch / 2 + 1 - apart) / 2, 0, 1)
        return 1 - float(inside @ kernel @ inside)

    return cast("float", fminbound(spill, -2, 2, xtol=0.01)) * wave_m


# Cached separately, so that a change of shift, rotation or focus recomputes only its own part.
@lru_cache(maxsize=4)
def _overlap(geometry: RelayGeometry, transmission: float) -> sparse.csc_array:
    return overlap_operator(geometry, transmission)


@lru_cache(maxsize=4)
def _blur(psf: FieldPsf, shape: tuple[int, int], pitch: int) -> SomeBlur:
    near = psf.middle(near_half(psf.kernel, _NEAR_PIXELS * pitch, _TAILS_SHARE))
    return with_tails(make_field_blur(near, shape), psf.kernel, near.half, pitch)
