"""The focus of the relay: where readings take least light from other panel pixels."""

import numpy as np
import pytest

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import prototype
from optsim.camera.parts.relay import Mount
from optsim.optics.aberrations import Wavefront

SIDES, PITCH, SPACING = (48, 64), 3, 6


def camera(**relay: object) -> CodedCamera:
    whole = prototype()
    sensor = whole.sensor.model_copy(update={"rows": 160, "cols": 208})
    clean = {"ghost_share": 0.0, "glare_share": 0.0, **relay}
    return whole.model_copy(
        update={
            "panel_rows": SIDES[0],
            "panel_cols": SIDES[1],
            "sensor": sensor,
            "relay": whole.relay.model_copy(update=clean),
        }
    )


def light_of_others(made: CodedCamera, part: str) -> float:
    """Share of other panel pixels in the readings of a lattice, by images of the lattice and of all."""
    operator, (row, col, _) = made.relay_operator(), made.relay_geometry().ccd_pixels(PITCH)
    lattice = np.zeros(SIDES)
    first = SPACING // 2
    lattice[first::SPACING, first::SPACING] = 1
    fine = lattice.repeat(PITCH, 0).repeat(PITCH, 1)
    seen = lattice > 0
    if part == "centre":
        seen[: SIDES[0] // 3] = seen[-SIDES[0] // 3 :] = False
        seen[:, : SIDES[1] // 3] = seen[:, -SIDES[1] // 3 :] = False
    own, every = (operator.apply(each)[row, col][seen] for each in (fine, np.ones_like(fine)))
    return float(1 - (own / every).mean())


@pytest.mark.parametrize("focus", ["centre", "field"])
def test_focused_readings_take_least_light_from_others(focus):
    at = {d: light_of_others(camera(focus=focus, defocus_m=d), focus) for d in (-12e-6, 0.0, 12e-6)}
    assert at[0.0] < min(at[-12e-6], at[12e-6])
    assert at[0.0] < light_of_others(camera(focus="paraxial"), focus)


def test_a_lens_without_aberrations_is_focused_in_its_sharp_image():
    flat, paraxial = (camera(wavefront=Wavefront(), focus=each) for each in ("field", "paraxial"))
    image = np.random.default_rng(1).uniform(0, 1, (SIDES[0] * PITCH, SIDES[1] * PITCH))
    np.testing.assert_array_equal(flat.relay_operator().apply(image), paraxial.relay_operator().apply(image))


def test_more_field_curvature_moves_the_best_focus_of_the_field_alone():
    found = {}
    for waves in (0.0, 0.139):
        wavefront = Wavefront(spherical_waves=0.07, curvature_waves=waves)
        for focus in ("centre", "field"):
            relay = camera(wavefront=wavefront, focus=focus).relay
            found[focus, waves] = relay.ccd_defocus_m(3.9, 4.54e-6, (144, 192), PITCH)
    assert found["centre", 0.0] == found["centre", 0.139]
    # The mean of h^2 over a rectangle is a third; a term c of Noll is 2 sqrt(3) c waves at the rim.
    third_m = -0.139 / 3 * 2 * np.sqrt(3) * 8 * 3.9**2 * 550e-9
    moved = found["field", 0.139] - found["field", 0.0]
    assert moved == pytest.approx(third_m, rel=0.35)


def test_a_warm_mount_moves_focus_shift_and_scale_as_its_lengths_grow():
    """100 mm of aluminium grow 2.3 um a kelvin, half a CCD pixel of 4.54 um."""
    mount = {"temperature_c": 35.0, "along_m": 0.1, "across_x_m": 0.05, "scale_per_k": 2e-6}
    cold, warm = camera(), camera(mount=Mount(**mount))
    was, now = (each.relay_geometry(PITCH).place(np.zeros(1), np.zeros(1)) for each in (cold, warm))
    middle = [each.relay_geometry(PITCH).place(np.array([72.0]), np.array([96.0])) for each in (cold, warm)]
    y, x = (float(middle[1][axis][0] - middle[0][axis][0]) for axis in (0, 1))
    assert (y, x) == pytest.approx((0.0, 10 * 23.1e-6 * 0.05 / 4.54e-6))
    half_px = float(middle[0][1][0] - was[1][0])
    assert float(now[1][0] - was[1][0]) - x == pytest.approx(-20e-6 * half_px)
    defocus_m = [each.relay.ccd_defocus_m(3.9, 4.54e-6, (144, 192), PITCH) for each in (cold, warm)]
    assert defocus_m[1] - defocus_m[0] == pytest.approx(10 * 2.31e-6)


def test_lengths_alone_move_nothing_and_temperature_alone_neither():
    for mount in (Mount(along_m=0.3, across_y_m=0.3), Mount(temperature_c=60.0)):
        assert camera(mount=mount).relay_geometry(PITCH) == camera().relay_geometry(PITCH)
        still = camera(mount=mount, focus="paraxial").relay
        assert still.ccd_defocus_m(3.9, 4.54e-6, (144, 192), PITCH) == 0
