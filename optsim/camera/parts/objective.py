"""The objective: from scene radiance to irradiance on the modulator."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Literal

from pydantic import Field, field_validator, model_validator

from optsim.camera.parts.lens import LARGEST_TAIL_SHARE, LensGroup
from optsim.core.quantities import Doubles
from optsim.core.units import parse_quantity
from optsim.optics.lens import STRONGEST_DISTORTION
from optsim.optics.radiometry import clipped_pupil, cos4, irradiance_factor

_FOCUS_WORDS = ("target", "everywhere")
_EITHER_WORD = ", ".join(_FOCUS_WORDS)
# The share that plans mostly choose at a tolerance of a tenth of the noise. If the prototype's whole field
# moves, with a window in it, a frame is off by half of that (`optsim bench capture`), by light that is not
# straight in time.
MOVING_TAIL_SHARE = 3.5e-3


class Objective(LensGroup):
    """A thin lens with distortion; its image is relayed onto the modulator at a magnification.

    Defocus by depth and the lens's direction belong to the renderer: it starts its paths on the lens. The
    image scale is that of a focus at infinity. For a nearer focus the image moves away from the lens by focal
    length over focus, 0.2 % for 12.5 mm at 7 m. The magnification is assumed to undo this.

    Parameters
    ----------
    focal_length_m : float
        Focal length of the objective itself, before ``magnification``, m.
    f_number : float
        f-number of the objective itself; the cone on the modulator is ``magnification`` times slower.
    magnification : float
        Magnification from the objective's image to the modulator.
    transmission : float
        Share of the light that the glass passes; 0.9 has no source, it is a sensible default.
    nd_transmission : float
        Transmission of a neutral density in front: the light rule sets it.
    aberration_m : float
        Standard deviation of the other aberrations' Gaussian on the modulator; 3 um has no source.
    glare_share : float
        Share of the light that veiling glare (ISO 9358) spreads evenly over the field; 0.25 % has no source.
    natural_vignetting : bool
        Whether irradiance falls with cos^4 of the field angle, corrected for distortion.
    clipped_share : float
        Mechanical vignetting: share of the pupil hidden by a lens rim at the corners of the used field. It
        takes light; PSF and bokeh keep the shape of the whole pupil.
    focus_m : float, "target" or "everywhere"
        Depth in focus along the axis, m; "target" is the scene camera's target; "everywhere" has no defocus.
        The default has no source: a photographer focuses on the subject.
    defocus_per_m : float
        Focus error, positive if too near, dioptres: 1/m.
    distortion : float
        Relative radial displacement at the corner of the used panel; it grows with the square of the distance
        from the centre. Positive is a pincushion, negative a barrel, as in the relay.
    moving_tail_share : float
        Share of the PSF's energy in its tails for moving light (:mod:`optsim.optics.psf_tails`). Tails and
        veiling glare are computed on a coarser grid and on straight lines in time. 0 images every instant
        separately.
    """

    focal_length_m: float = Field(default=12.5e-3, gt=0, le=1)
    f_number: float = Field(default=4.0, ge=0.7, le=64)
    magnification: float = Field(default=1.5, gt=0)
    transmission: float = Field(default=0.9, gt=0, le=1)
    nd_transmission: float = Field(default=1.0, gt=0, le=1)
    aberration_m: float = Field(default=3e-6, ge=0)
    glare_share: float = Field(default=0.0025, ge=0, lt=1)
    natural_vignetting: bool = True
    clipped_share: float = Field(default=0.0, ge=0, le=0.9)
    focus_m: float | Literal["target", "everywhere"] = "target"
    defocus_per_m: float = Field(default=0.0, ge=0, le=10)
    distortion: float = Field(default=0.0, ge=-STRONGEST_DISTORTION, le=STRONGEST_DISTORTION)
    moving_tail_share: float = Field(default=MOVING_TAIL_SHARE, ge=0, le=LARGEST_TAIL_SHARE)

    @field_validator("focus_m", mode="before")
    @classmethod
    def _distance_or_word(cls, value: object) -> object:
        """Read a length with its unit; the two words pass unchanged."""
        if not isinstance(value, str) or value in _FOCUS_WORDS:
            return value
        try:
            return parse_quantity("focus_m", value)
        except ValueError as error:
            near = get_close_matches(value, _FOCUS_WORDS, n=1, cutoff=0.7)
            cure = f"did you mean {near[0]!r}?" if near else f"{error}; or one of the words {_EITHER_WORD}"
            raise ValueError(cure) from None

    @model_validator(mode="after")
    def _image_behind_the_lens(self) -> Objective:
        if not isinstance(self.focus_m, str) and not 2 * self.focal_length_m <= self.focus_m <= 1e6:
            raise ValueError(
                f"focus_m: got {self.focus_m:g} m, expected at least twice the focal length of "
                f"{self.focal_length_m:g} m and at most 1e6 m, or one of the words {_EITHER_WORD}"
            )
        return self

    @model_validator(mode="after")
    def _cone_within_a_half_space(self) -> Objective:
        if self.working_f_number < 0.5:
            raise ValueError(
                f"magnification x f_number: got f/{self.working_f_number:.3g} on the panel, expected at "
                "least f/0.5, light from a whole half space; raise one of them"
            )
        return self

    @property
    def working_f_number(self) -> float:
        """f-number of the cone on the modulator."""
        return self.magnification * self.f_number

    @property
    def irradiance_per_radiance(self) -> float:
        """Irradiance on the modulator, on axis and without glare, W m^-2 per W m^-2 sr^-1."""
        return irradiance_factor(self.working_f_number, self.transmission * self.nd_transmission)

    @property
    def aperture_m(self) -> float:
        """Diameter of the entrance pupil, m."""
        return self.focal_length_m / self.f_number

    def tan_per_metre(self) -> float:
        """Tangent of the field angle per metre on the modulator, near the axis."""
        return 1 / (self.magnification * self.focal_length_m)

    def shading(self, rows: int, cols: int, cell_m: float) -> Doubles:
        """Relative irradiance of a flat field at the samples of a used field, (y, x); 1 on axis."""
        pupil = clipped_pupil(rows, cols, self.clipped_share)
        if not self.natural_vignetting:
            return pupil
        return pupil * cos4(rows, cols, cell_m * self.tan_per_metre(), self.distortion)
