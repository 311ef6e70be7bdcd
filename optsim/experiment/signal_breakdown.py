# pyright: reportMissingTypeStubs=false
"""Signal breakdown: electrons of one CCD pixel by origin, slot and panel pixel.

The expected signal of a pixel is linear in the weights of all panel pixels:

    e = dark current + sum over paths, instants and panel pixels of
        weight x electrons that this panel pixel would give here in this instant if it were fully on

The paths are parts of one row of the relay's operator, from its adjoint: direct (PSF and overlap), ghost
and veil. So the electrons split by path and by the panel pixel that transmitted the light, without a
remainder. With fringing fields a pixel also drives the fringe of its neighbours.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from optsim.camera.camera import CodedCamera
from optsim.core.quantities import Doubles, ExposureCode, Floats, IrradianceVideo, PanelState, Video
from optsim.optics.fringe_correction import cell_weights
from optsim.optics.fringing import fine_image, fine_image_adjoint, whole_cells
from optsim.report.trace_record import ConvertedReading, OwnPixel

NEAR_PX = 5
_SIGMAS = 9.0  # 1e-18 of a Poisson distribution lies beyond

# In the order of the light path; each electron has exactly one origin.
ORIGINS: dict[str, str] = {
    "own_open": "own panel pixel while it is commanded open, at any level above 0",
    "own_leak": "own panel pixel while it is commanded dark: what the finite contrast lets through, settled",
    "own_late": "own panel pixel while it is commanded dark: what it lets through beyond that, because the "
    "crystal has not relaxed yet, its row's turn has not come, or it stands still",
    "neighbours": "the 8 panel pixels around it, open or dark",
    "near_field": f"panel pixels 2 to {NEAR_PX} away",
    "wings": f"panel pixels more than {NEAR_PX} away, through the wings of the relay's PSF",
    "ghost": "the relay's ghost, from all panel pixels",
    "veil": "the relay's veiling glare, from all panel pixels",
    "dark_current": "dark current of the CCD",
    "smear": "the other pixels of its column while the frame is read out",
}


def light_paths(camera: CodedCamera, y: int, x: int, pitch: int) -> Doubles:
    """Electrons in a CCD pixel per radiant exposure behind each fine cell of the panel, path by path."""
    pixel = np.zeros((camera.sensor.rows, camera.sensor.cols))
    pixel[y, x] = 1
    glare, ghost = camera.relay.glare_share, camera.relay.ghost_share

    def row(**shares: float) -> Doubles:
        relay = camera.relay.model_copy(update=shares)
        return camera.model_copy(update={"relay": relay}).relay_operator(pitch).adjoint(pixel)

    direct = (1 - glare) * (1 - ghost) * row(glare_share=0.0, ghost_share=0.0)
    without_veil = (1 - glare) * row(glare_share=0.0)
    rows = np.stack([direct, without_veil - direct, row() - without_veil])
    return camera.photon_electrons(pixel)[y, x] * rows


@dataclass(frozen=True, eq=False)
class Electrons:
    """Expected electrons of a CCD pixel in one frame, before any clip."""

    by_slot: dict[str, Doubles]  # Origin -> array (slot,); without smear, which arises later.
    by_pixel: Doubles  # (v, u), on the direct path from each panel pixel.
    weight: Doubles  # (slot,), effective weight of the own panel pixel, regardless of the shutter.


def count_electrons(
    camera: CodedCamera,
    truth: IrradianceVideo,
    index: int,
    code: ExposureCode,
    panel: PanelState | None,
    paths: Doubles,
    own: tuple[int, int],
) -> Electrons:
    """Count the electrons of a CCD pixel by origin."""
    n_sub, slots, coded = truth.instants_per_slot, camera.slots_per_frame, camera.coded_slots
    weights, _ = camera.panel_weights(code, panel, n_sub)
    shutter, _ = camera.shutter(code, panel, n_sub, truth.samples_per_pitch)
    borders, fringe = shutter.borders, shutter.fringe_correction
    cells = cell_weights(fringe, shutter.weights, truth.slots_per_segment) if fringe else None
    fully_on = whole_cells(camera.panel_gain, truth.samples_per_pitch) * np.float64(truth.slot_s / n_sub)
    leak = camera.column_leaks[own[1]]
    v, u = np.indices(truth.panel_shape)
    away_px = np.maximum(abs(v - own[0]), abs(u - own[1]))
    ring = np.searchsorted([0, 1, NEAR_PX], away_px.ravel())  # own, neighbours, near field, wings
    by_slot = {name: np.zeros(slots) for name in ORIGINS if name != "smear"}
    by_slot["dark_current"][:coded] = camera.dark_e / coded
    by_pixel = np.zeros(truth.panel_shape)
    for t, light in enumerate(_instants(truth, index * slots, slots)):
        slot = t // n_sub
        if slot >= coded:
            break
        if cells is not None:
            # A fringe's deviation from a mix of weights counts for the pixels that drive it.
            mixed = fine_image(shutter.weights[t], borders)
            light = light * np.divide(cells[t], mixed, out=np.ones(mixed.shape), where=mixed > 0)
        direct, ghost, veil = (fine_image_adjoint(path * light * fully_on, borders) for path in paths)
        passed = direct * weights[t]
        by_pixel += passed
        mine, neighbours, near_field, wings = np.bincount(ring, passed.ravel(), minlength=4)
        if code.levels[slot, *own] > 0:
            by_slot["own_open"][slot] += mine
        else:
            by_slot["own_leak"][slot] += direct[own] * leak
            by_slot["own_late"][slot] += mine - direct[own] * leak
        by_slot["neighbours"][slot] += neighbours
        by_slot["near_field"][slot] += near_field
        by_slot["wings"][slot] += wings
        by_slot["ghost"][slot] += (ghost * weights[t]).sum()
        by_slot["veil"][slot] += (veil * weights[t]).sum()
    weight = weights[:, *own].reshape(slots, n_sub).mean(axis=1, dtype=np.float64)
    return Electrons(by_slot, by_pixel, weight)


def look_at(camera: CodedCamera, y: int, x: int, pitch: int, even: Doubles) -> OwnPixel:
    """Find the panel pixel that a CCD pixel belongs to."""
    geometry = camera.relay_geometry(pitch)
    row, col, on_ccd = geometry.ccd_pixels(pitch)
    picking = on_ccd & (row == y) & (col == x)
    if picking.any():
        relation, at = "picked", int(picking.argmax())
    elif even.max() > 0:
        relation, at = "most light", int(even.argmax())
    else:
        relation, at = "outside", int(np.hypot(row - y, col - x).argmin())
    v, u = divmod(at, even.shape[1])
    centre_y, centre_x = geometry.place(np.array((v + 0.5) * pitch), np.array((u + 0.5) * pitch))
    return OwnPixel(
        v=v,
        u=u,
        relation=relation,
        offset_v_px=float(y + 0.5 - centre_y) / camera.ratio,
        offset_u_px=float(x + 0.5 - centre_x) / camera.ratio,
        share=float(even[v, u] / even.sum()) if even.max() > 0 else 0.0,
        stuck=bool(camera.stuck_pixels[0][v, u]),
    )


def seen_per_slot(video: Video, first_slot: int, n_slots: int, seen: Doubles) -> Doubles:
    """Average the light of each slot under sets of weights on the fine grid, (k, y, x)."""
    means = np.zeros((len(seen), n_slots))
    for t, light in enumerate(_instants(video, first_slot, n_slots)):
        means[:, t // video.instants_per_slot] += np.tensordot(seen, light, 2)
    whole = seen.sum(axis=(1, 2)) * video.instants_per_slot
    return means / np.where(whole > 0, whole, np.nan)[:, None]


def read_out(camera: CodedCamera, expected_e: Doubles, y: int, x: int, drawn_dn: int) -> ConvertedReading:
    """Convert the expected electrons of a frame, (y, x), to the digital number of one pixel."""
    ccd, mean_e = camera.sensor, float(expected_e[y, x])
    smear_e = float(ccd.smear_e(expected_e, camera.exposure_s)[x])
    dsnu_e = float(ccd.dark_signal_e(camera.serial_number)[y, x])
    counts, chance = _poisson(max(mean_e, 0.0))
    held = np.minimum(counts, ccd.full_well_e)
    bent = ccd.bent(held + smear_e)
    bent_e = float(chance @ bent)
    shot_e = float(np.sqrt(chance @ (bent - bent_e) ** 2))
    quantisation_e = ccd.step_e / np.sqrt(12)
    sigma_e = np.sqrt(shot_e**2 + smear_e + ccd.read_noise_e**2 + quantisation_e**2)
    dn = (bent_e + dsnu_e) / ccd.step_e + ccd.zero_dn
    at_well = "at the full well" if mean_e >= ccd.full_well_e else "no"
    return ConvertedReading(
        collected_e=mean_e,
        lost_at_well_e=float(chance @ (counts - held)),
        smear_e=smear_e,
        lost_to_bend_e=float(chance @ (held + smear_e - bent)),
        dsnu_e=dsnu_e,
        signal_e=bent_e + dsnu_e,
        gain_e=ccd.step_e,
        black_dn=ccd.zero_dn,
        shot_noise_e=shot_e,
        smear_noise_e=float(np.sqrt(smear_e)),
        read_noise_e=ccd.read_noise_e,
        quantisation_noise_e=float(quantisation_e),
        sigma_dn=float(sigma_e / ccd.step_e),
        expected_dn=min(max(dn, 0.0), float(ccd.max_dn)),
        clipped="by the converter" if dn >= ccd.max_dn else at_well,
        drawn_dn=drawn_dn,
    )


def _poisson(mean: float) -> tuple[Doubles, Doubles]:
    """Return the counts that occur, and the probability of each."""
    reach = _SIGMAS * np.sqrt(mean) + 30
    counts = np.arange(max(0, int(mean - reach)), int(mean + reach) + 2, dtype=np.float64)
    if mean == 0:
        return np.zeros(1), np.ones(1)
    chance = np.exp(counts * np.log(mean) - mean - gammaln(counts + 1))
    return counts, chance / chance.sum()


def _instants(video: Video, first_slot: int, n_slots: int) -> Iterator[Floats]:
    """Light of each instant, (y, x)."""
    for _, segment in video.segments(first_slot, first_slot + n_slots):
        for index in range(segment.n_instants):
            yield segment.instant(index)
