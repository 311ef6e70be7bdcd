"""How well calibrations explain images of a bench that neither was made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from optsim.calibration.bench import Bench
from optsim.calibration.bench_images import Flat, Patches
from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import noise_variance
from optsim.core.errors import BenchError, ConfigError
from optsim.core.quantities import CodedFrame, ExposureCode, Floats
from optsim.optics.panel import settled_panel

# A pixel's deviation counts up to so many standard deviations: one hot pixel must not decide.
_BOUND_SIGMAS = 30.0
# Frames that a setting keeps for the calibration: photon transfer needs pairs of flats.
_FLATS_KEPT, _LATTICES_KEPT = 2, 2
_SAME_TIME = 1e-3  # relative
Shown = Flat | Patches
_Group = TypeVar("_Group", Flat, Patches)


@dataclass(frozen=True)
class Explained:
    """How far two calibrations' predictions of a held-out image are off, in standard deviations of its noise.

    Parameters
    ----------
    name : str
        The image's set on the bench.
    before, after : float
        Rms deviation by the earlier and by the later calibration; 1 is noise alone.
    """

    name: str
    before: float
    after: float


def held_out(bench: Bench) -> tuple[Bench, tuple[tuple[str, Shown], ...]]:
    """Split a bench: the rest to calibrate from, and one image of each setting whose panel is held.

    Of lattices with single images the last is held out.

    Raises
    ------
    BenchError
        When no setting has an image to spare.
    """
    found: list[tuple[str, Shown]] = []

    def spared(name: str, groups: Sequence[_Group], kept: int) -> tuple[_Group, ...]:
        rest: list[_Group] = []
        for number, group in enumerate(groups):
            if len(group.dn) > kept:
                found.append((f"{name}[{number}]", replace(group, dn=group.dn[-1:])))
                rest.append(replace(group, dn=group.dn[:-1]))
            else:
                rest.append(group)
        return tuple(rest)

    dots = spared("dots", bench.dots, 1)
    if all(len(group.dn) == 1 for group in bench.dots) and len(dots) > _LATTICES_KEPT:
        found.append((f"dots[{len(dots) - 1}]", dots[-1]))
        dots = dots[:-1]
    rest = replace(
        bench,
        dots=dots,
        flats=spared("flats", bench.flats, _FLATS_KEPT),
        off=spared("off", (bench.off,), 1)[0],
        greys=spared("greys", bench.greys, 1),
        glare=spared("glare", bench.glare, 1),
    )
    if len(found) < 2:
        raise BenchError(
            f"bench: got {len(found)} settings with an image to spare, expected 2 or more to compare "
            "calibrations; cure: two frames of each lattice of dots, or no --before"
        )
    return rest, tuple(found)


def check_same_camera(before: Calibration, bench: Bench, where: object) -> None:
    """Refuse to compare with a calibration of another camera.

    Raises
    ------
    ConfigError
        With what differs.
    """
    for what, got, expected in (
        ("panel pixels (rows, columns)", before.shape, bench.panel_shape),
        ("CCD pixels (rows, columns)", before.ccd_shape, bench.darks.shape[1:]),
        ("slots a frame", before.slots_per_frame, bench.slots_per_frame),
        ("slots with the shutter open", before.coded_slots, bench.coded_slots),
    ):
        if got != expected:
            raise ConfigError(
                f"--before {where}: got {got} {what}, expected {expected} as the bench has; cure: name an "
                "earlier calibration of this camera"
            )
    if abs(before.slot_s / bench.slot_s - 1) > _SAME_TIME:
        raise ConfigError(
            f"--before {where}: got slots of {before.slot_s:g} s, expected {bench.slot_s:g} s as the bench "
            "has; cure: name an earlier calibration of this camera"
        )


def explained(
    before: Calibration, after: Calibration, images: Sequence[tuple[str, Shown]]
) -> tuple[Explained, ...]:
    """Compare two calibrations on images that are held out, by the noise that the later one knows."""
    return tuple(
        Explained(name, _off(before, after, group), _off(after, after, group)) for name, group in images
    )


def _off(calibration: Calibration, noise: Calibration, group: Shown) -> float:
    """Rms deviation of an image from its prediction, in standard deviations of its noise."""
    levels = (
        group.levels(calibration.shape)
        if isinstance(group, Patches)
        else np.full(calibration.shape, group.level, np.uint8)
    )
    held = np.repeat(levels[None], calibration.slots_per_frame, axis=0)
    code = ExposureCode(held, np.zeros(calibration.shape, np.bool_))
    weights, _ = calibration.weights(code, settled_panel(levels, calibration.response))
    light: Floats = weights.sum(axis=0) * np.float32(group.irradiance_w_m2)
    expected = calibration.mix(light)
    seen = calibration.observe(CodedFrame(0, group.dn[0], code))
    known = replace(calibration, dn_per_e=noise.dn_per_e, read_noise_dn=noise.read_noise_dn)
    use = seen.valid & ~seen.saturated
    if not use.any():
        return _BOUND_SIGMAS
    squared = (seen.signal - expected) ** 2 / noise_variance(known, expected)
    return float(np.sqrt(np.minimum(squared[use], _BOUND_SIGMAS**2).mean(dtype=np.float64)))
