"""Joint transmission of splitter, polarisers and panel: contrast is an output, never an input."""

from __future__ import annotations

import numpy as np

from optsim.camera.parts.modulator import Modulator
from optsim.camera.parts.splitter import Splitter
from optsim.core.quantities import Doubles
from optsim.optics.mueller import UNPOLARISED
from optsim.optics.radiometry import MONO_WAVELENGTH_M

_PERFECT = 1e12  # contrast of an ideal polariser


def stage_transmissions(
    splitter: Splitter,
    modulator: Modulator,
    retardance_rad: float,
    panel_f_number: float,
    x_m: Doubles,
    wavelength_m: float = MONO_WAVELENGTH_M,
) -> Doubles:
    """Power transmission of the path in, of the panel and of the path out, for unpolarised light.

    Parameters
    ----------
    splitter, modulator
        True parts.
    retardance_rad : float
        Round-trip retardance of the panel: 0 dark, pi bright.
    panel_f_number : float
        f-number of the cone on the panel, taken as evenly filled.
    x_m : ndarray of shape (point,), float64
        Positions on the panel from the axis, along its rows.
    wavelength_m : float
        Wavelength of the light, m; the retardance holds in it.

    Returns
    -------
    ndarray of shape (3, point), float64
        Mean over the rays of each point.
    """
    rays = splitter.rays(x_m, panel_f_number)
    at_panel = splitter.inbound(rays, wavelength_m) @ UNPOLARISED
    back = (modulator.mueller(retardance_rad) @ at_panel[..., None])[..., 0]
    out = (splitter.outbound(rays, wavelength_m) @ back[..., None])[..., 0]
    passed = np.stack([stokes[..., 0].mean(axis=-1) for stokes in (at_panel, back, out)])
    before = passed[:-1].copy()
    # No light in gives no light out: a coating far from its angle, or crossed ideal polarisers.
    passed[1:] = np.divide(passed[1:], before, out=np.zeros_like(before), where=before > 0)
    return passed


def throughput(
    splitter: Splitter,
    modulator: Modulator,
    retardance_rad: float,
    panel_f_number: float,
    x_m: Doubles,
    wavelength_m: float = MONO_WAVELENGTH_M,
) -> Doubles:
    """Power transmission of the whole chain for unpolarised light at points of the panel, (point,).

    Affine in cos(retardance); arguments as of :func:`stage_transmissions`.
    """
    stages = stage_transmissions(splitter, modulator, retardance_rad, panel_f_number, x_m, wavelength_m)
    return stages.prod(axis=0)


def leak(
    splitter: Splitter,
    modulator: Modulator,
    panel_f_number: float,
    x_m: Doubles,
    wavelength_m: float = MONO_WAVELENGTH_M,
) -> Doubles:
    """Transmission fully off over fully on at points of the panel, (point,): one over the system contrast.

    0 where no light passes at all.
    """
    ends = (0.0, modulator.white_rad(wavelength_m))
    off, on = (throughput(splitter, modulator, g, panel_f_number, x_m, wavelength_m) for g in ends)
    return np.divide(off, on, out=np.zeros_like(on), where=on > 0)


def leak_budget(
    splitter: Splitter,
    modulator: Modulator,
    panel_f_number: float,
    x_m: Doubles,
    wavelength_m: float = MONO_WAVELENGTH_M,
) -> dict[str, Doubles]:
    """Leak by each source alone and by all together, at points of the panel, (point,).

    Arguments as of :func:`leak`. One over the contrast is nearly the sum of the leaks of each source with
    everything else perfect.
    """
    perfect_cube = splitter.model_copy(update={"placement": "collimated", "cleanup_contrast": _PERFECT})
    perfect_panel = _only(modulator)
    straight = splitter.model_copy(update={"placement": "collimated"})

    def of(cube: Splitter, panel: Modulator, places_m: Doubles) -> Doubles:
        return leak(cube, panel, panel_f_number, places_m, wavelength_m)

    on_axis = of(straight, perfect_panel, 0 * x_m)
    return {
        "light that the panel depolarises": of(perfect_cube, _only(modulator, "depolarised_share"), x_m),
        "light from the gaps between its mirrors": of(
            perfect_cube, _only(modulator, "gap_reflectivity"), x_m
        ),
        "coating at 45 degrees, with its polarisers": on_axis,
        "coating at other angles, skew rays": of(splitter, perfect_panel, x_m) - on_axis,
        "all together": of(splitter, modulator, x_m),
    }


def _only(modulator: Modulator, *flaws: str) -> Modulator:
    """Return a panel with these flaws alone."""
    leaks = {"depolarised_share", "gap_reflectivity"}
    return modulator.model_copy(update=dict.fromkeys(leaks - {*flaws}, 0.0))


def check_contrast(
    splitter: Splitter, modulator: Modulator, panel_f_number: float, wavelength_m: float
) -> None:
    """Refuse parts that together pass no light, or more of it from a dark panel than from a bright one."""
    white_rad, at = modulator.white_rad(wavelength_m), (panel_f_number, np.zeros(1), wavelength_m)
    most_waves = white_rad * max(modulator.drives) / (2 * np.pi)
    if most_waves >= 1:
        raise ValueError(
            f"modulator.half_wave_m: got {modulator.half_wave_m * 1e9:g} nm, in light of "
            f"{wavelength_m * 1e9:g} nm white is up to {most_waves:.3g} waves, expected less than one; lower "
            "it, or choose light nearer to it"
        )
    off, on = (float(throughput(splitter, modulator, gamma, *at)[0]) for gamma in (0, white_rad))
    if on <= 0 or off > on * (1 + 1e-9):
        raise ValueError(
            f"splitter: a bright panel passes {on:.3g} of the light and a dark one {off:.3g}, expected a "
            "contrast of at least 1; raise tp over ts and rs over rp, or acceptance_rad, or choose light "
            "nearer to modulator.half_wave_m"
        )
