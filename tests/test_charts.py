"""Measurement targets are what their docstrings say: cycles, angles, densities and centres."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from optsim.scene import charts
from optsim.scene.surfaces import SURFACES
from optsim.scene.textures import reflectance_map


@pytest.mark.parametrize("radius", [0.1, 0.25, 0.45])
def test_siemens_star_has_36_sinusoidal_cycles_of_known_amplitude(radius):
    image = charts.siemens_star()
    n = len(image)
    angle = 2 * np.pi * np.arange(1440) / 1440
    x, y = (0.5 + radius * np.array([np.cos(angle), np.sin(angle)])) * n - 0.5
    spectrum = np.abs(np.fft.rfft(map_coordinates(image, [y, x], order=1))) / 1440
    assert spectrum[0] == pytest.approx(0.5, abs=1e-3)
    # Sampling between texels takes a little from the amplitude where cycles are short.
    assert 2 * spectrum[36] == pytest.approx(0.4, rel=0.02)
    rest = np.delete(spectrum, [0, 36])
    assert rest.max() < 0.002


def test_siemens_star_has_a_light_ray_to_the_right():
    image = charts.siemens_star()
    assert image[512, 900] == pytest.approx(0.9, abs=0.02)
    assert image[5, 5] == image[512, 512] == pytest.approx(0.5)


def test_slanted_edges_stand_at_five_degrees_with_a_contrast_of_four():
    image = charts.slanted_edge()
    assert image.max() / image.min() == pytest.approx(4.0)
    # Right edge: in each row, the share of dark texels right of the middle says where it lies.
    rows = np.arange(180, 332)
    place = ((0.6 - image[rows, 256:]) / 0.45).sum(axis=1)
    slope, offset = np.polyfit(rows + 0.5 - 256, place, 1)
    assert np.degrees(np.arctan(slope)) == pytest.approx(-5.0, abs=0.02)
    assert offset == pytest.approx(0.3 * 512 / np.cos(charts.EDGE_RAD), abs=0.1)


def test_wedge_and_greys_have_their_densities():
    wedge = charts.step_wedge()
    fields = wedge.reshape(64, charts.WEDGE_STEPS, 64)
    np.testing.assert_allclose(np.ptp(fields, axis=(0, 2)), 0)
    np.testing.assert_allclose(fields[0, :, 0], 0.9 / 2.0 ** np.arange(11))
    assert fields[0, 0, 0] / fields[0, -1, 0] == pytest.approx(1024)
    greys = charts.grey_steps()[0].reshape(6, 64)[:, 32]
    np.testing.assert_allclose(-np.log10(greys), [0.05, 0.23, 0.44, 0.70, 1.05, 1.50])


def test_bars_are_half_dark_with_the_dark_half_first():
    row = charts.bars()[0]
    np.testing.assert_array_equal(row, np.repeat([0.09, 0.9], 64))


def test_fiducial_is_a_saddle_at_its_centre():
    image = charts.fiducial()
    np.testing.assert_allclose(image, image[::-1, ::-1], atol=1e-12)  # half a turn about the centre
    lower_left, lower_right = image[100, 100], image[100, 156]
    assert (lower_left, lower_right) == pytest.approx((0.05, 0.9))


@pytest.mark.parametrize("name", [*charts.CHARTS, *SURFACES])
def test_textures_are_reflectances_and_the_same_every_time(name):
    image = reflectance_map(name)
    assert image.min() >= 0
    assert image.max() <= 0.95
    assert np.ptp(image) > 0.1
    again = {**charts.CHARTS, **SURFACES}[name]()
    np.testing.assert_allclose(np.clip(again, 0, 0.95), image, atol=1e-6)


@pytest.mark.parametrize(
    "name", ["asphalt", "cobbles", "concrete", "facade", "parquet", "terrazzo", "wallpaper"]
)
def test_repeated_surfaces_have_no_seam(name):
    """Steps across the seam are like those between other neighbours, on either pair of sides."""
    image = SURFACES[name]()
    for axis in (0, 1):
        seam = np.abs(np.take(image, 0, axis) - np.take(image, -1, axis)).mean()
        inside = np.sort(np.abs(np.diff(image, axis=axis)).mean(axis=1 - axis))
        assert seam <= inside[-1] * 1.05
