"""The polarising beam splitter with its clean-up polarisers: p goes to the panel, s comes back to the CCD."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.core.quantities import Doubles
from optsim.optics.mueller import polariser, turned
from optsim.optics.radiometry import MONO_WAVELENGTH_M

# Rings of equal area over the cone, and rays per ring: the leak of skew rays is then off by less than 0.5 %.
_RINGS, _RAYS = 8, 12


@dataclass(frozen=True, eq=False)
class Rays:
    """Angles of rays on the splitter.

    Parameters
    ----------
    incidence_rad : ndarray of shape (..., n), float64
        Angle of incidence on the coating minus 45 degrees, in glass.
    skew_rad : ndarray of shape (..., n), float64
        Rotation of the coating's p and s about the ray on the way in; opposite on the way out.
    """

    incidence_rad: Doubles
    skew_rad: Doubles


class Splitter(Part):
    """A cube that transmits p towards the panel and reflects the returning s towards the CCD.

    Defaults of the coating are those of a typical broadband visible cube; no data sheet was at hand, so they
    have no source. Clean-up polarisers stand before and behind it, each with its transmission and contrast.

    For a polarised scene only p reaches the panel. Irradiance on the modulator is unpolarised-equivalent, so
    the scene's radiance is then twice the component along p, S0 + S1 cos 2a + S2 sin 2a. The crossed
    component is not modelled: ts over tp times cleanup_contrast, 1.1e-6 of the crossed light (1.1e-3 without
    a clean-up polariser).

    Parameters
    ----------
    tp, ts : float
        Transmittance of the coating for p and for s at 45 degrees, towards the panel.
    rs, rp : float
        Reflectance of the coating for s and for p at 45 degrees, towards the CCD. With the transmittance it
        is at most 1; the rest is absorbed.
    azimuth_rad : float
        Direction of p in the upright picture, from its rows, positive anticlockwise. 0 is p along the rows:
        the coating's plane of incidence is along them. Other values rotate the analysed direction, as a
        half-wave plate in front would. They do not change the angles on the coating.
    scene_light : {"auto", "polarised", "unpolarised"}
        Whether the scene is rendered with its polarisation; auto: if any of its materials polarises.
        "unpolarised" models a perfect depolariser in front.
    placement : {"collimated", "converging"}
        Position in the beam. In collimated space all light of a panel point meets the coating at one angle,
        which varies over the columns. It returns along its own path, so skew adds no leak in a dark panel. A
        bright one passes 1.2 % less 5 mm above or below the middle row, where p is rotated: not modelled. In
        converging space every point gets the whole cone. There skew rays leak, since p and s are rotated for
        them.
    collimator_m : float
        Focal length between splitter and panel, for collimated space; no source.
    glass_index : float
        Refractive index of the cube's glass; 1.52 is that of common crown glass (no source).
    acceptance_rad : float
        Angle from 45 degrees, in glass, within which the coating keeps its values. Beyond it ts and rp grow
        with the square of the angle over it, at the expense of tp and rs (about 2 degrees; no source).
    chromatic_m : float
        Distance from 550 nm at which ts and rp double; they grow with the square of the distance. 100 nm has
        no source. Polarisers and faces are the same at every wavelength.
    shortest_m, longest_m : float
        Range in which the coating is known: the usual one of broadband visible cubes; no data sheet was at
        hand. A design that is flat even from 400 to 700 nm: Appl. Opt. 35(13), 2221 (1996).
    face_transmission : float
        Share of the light that the cube's faces pass, all together, both passes; no source.
    cleanup_transmission : float
        Transmission of each clean-up polariser, for the light it should pass; no source. 1 with contrast 1:
        none.
    cleanup_contrast : float
        Wanted over unwanted transmission of each clean-up polariser; no source.
    """

    tp: float = Field(default=0.95, gt=0, le=1)
    ts: float = Field(default=0.001, ge=0, le=1)
    rs: float = Field(default=0.99, gt=0, le=1)
    rp: float = Field(default=0.03, ge=0, le=1)
    azimuth_rad: float = Field(default=0.0, ge=-np.pi, le=np.pi)
    scene_light: Literal["auto", "polarised", "unpolarised"] = "auto"
    placement: Literal["collimated", "converging"] = "collimated"
    collimator_m: float = Field(default=75e-3, gt=0)
    glass_index: float = Field(default=1.52, ge=1, le=3)
    acceptance_rad: float = Field(default=0.035, gt=0)
    chromatic_m: float = Field(default=100e-9, ge=1e-9)
    shortest_m: float = Field(default=420e-9, gt=0)
    longest_m: float = Field(default=680e-9, gt=0)
    face_transmission: float = Field(default=0.97, gt=0, le=1)
    cleanup_transmission: float = Field(default=0.9, gt=0, le=1)
    cleanup_contrast: float = Field(default=1000.0, ge=1)

    @model_validator(mode="after")
    def _ports_add_up(self) -> Splitter:
        for light, passed, turned_away in (("p", self.tp, self.rp), ("s", self.ts, self.rs)):
            if passed + turned_away > 1 + 1e-9:
                raise ValueError(
                    f"t{light} + r{light}: got {passed:g} + {turned_away:g}, expected at most 1: the coating "
                    f"can't send on more {light} light than it gets; lower one of them"
                )
        return self

    def check_band(self, wavelength_m: float) -> None:
        """Refuse light for which the coating is not known.

        Raises
        ------
        ConfigError
            With the keys.
        """
        if not self.shortest_m <= wavelength_m <= self.longest_m:
            raise ConfigError(
                f"camera.wavelength_m: got {wavelength_m * 1e9:g} nm, expected {self.shortest_m * 1e9:g} to "
                f"{self.longest_m * 1e9:g} nm, where the splitter's coating is known; choose another band, "
                "or state a coating by camera.splitter.shortest_m and longest_m"
            )

    def rays(self, x_m: Doubles, panel_f_number: float) -> Rays:
        """Rays through points of the panel: arrays (point, ray).

        Parameters
        ----------
        x_m : ndarray of shape (point,), float64
            Position on the panel from the axis, in the coating's plane of incidence: along its rows.
        panel_f_number : float
            f-number of the cone on the panel.
        """
        if self.placement == "collimated":
            angle = np.arcsin(np.sin(np.arctan(x_m / self.collimator_m)) / self.glass_index)
            return Rays(angle[:, None], np.zeros((len(x_m), 1)))
        edge = 1 / (2 * panel_f_number * self.glass_index)  # sine of the cone's half angle in glass
        radius = np.repeat(edge * np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS), _RAYS)
        turn = np.tile(2 * np.pi * (np.arange(_RAYS) + 0.5) / _RAYS, _RINGS)
        a, b = radius * np.cos(turn), radius * np.sin(turn)
        c = np.sqrt(1 - a**2 - b**2)
        # Ray (a, b, c), coating's normal (1, 0, 1)/sqrt 2: s is their vector product, (b, c - a, -b).
        incidence = np.arccos(np.clip((a + c) / np.sqrt(2), -1, 1)) - np.pi / 4
        skew = np.arctan2(b, c - a)
        wide = np.ones((len(x_m), 1))
        return Rays(incidence * wide, skew * wide)

    def inbound(self, rays: Rays, wavelength_m: float = MONO_WAVELENGTH_M) -> Doubles:
        """Mueller matrices from the objective to the panel, one a ray."""
        wanted, growth = self.cleanup_transmission, self._growth(rays, wavelength_m)
        coating = polariser(np.maximum(self.tp - self.rp * (growth - 1), 0), np.minimum(self.ts * growth, 1))
        return turned(coating, rays.skew_rad) @ polariser(wanted, wanted / self.cleanup_contrast)

    def outbound(self, rays: Rays, wavelength_m: float = MONO_WAVELENGTH_M) -> Doubles:
        """Mueller matrices from the panel to the relay, one a ray, with the transmission of the faces."""
        wanted = self.cleanup_transmission * self.face_transmission
        growth = self._growth(rays, wavelength_m)
        coating = polariser(np.minimum(self.rp * growth, 1), np.maximum(self.rs - self.ts * (growth - 1), 0))
        # Rotated the other way, seen from behind the mirror: the same angle.
        return polariser(wanted / self.cleanup_contrast, wanted) @ turned(coating, rays.skew_rad)

    def growth_of_leak(self, wavelength_m: float) -> float:
        """Ratio of ts and rp at 45 degrees at a wavelength to those at 550 nm."""
        return 1 + ((wavelength_m - MONO_WAVELENGTH_M) / self.chromatic_m) ** 2

    def _growth(self, rays: Rays, wavelength_m: float) -> Doubles:
        by_angle = np.maximum((rays.incidence_rad / self.acceptance_rad) ** 2, 1.0)
        return by_angle * self.growth_of_leak(wavelength_m)
