"""Rims of panel pixels under fringing fields: quadrature, loops, segments."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from optsim.camera.effect_sizes import effect_sizes
from optsim.camera.effects import changed, with_effects
from optsim.camera.hardware import demo
from optsim.camera.probe import PLAIN, Illumination, compared_with, make_probe
from optsim.core import threads
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Block, ExposureCode, Segment, Video
from optsim.experiment.experiment import load_experiment
from optsim.optics import fringe_correction as fringe_module
from optsim.optics.fringe_correction import FringeCorrection, cell_weights, relaxed
from optsim.optics.fringe_loops import fill_cells
from optsim.optics.fringing import border_shares, fine_image
from optsim.optics.integrate import Shutter, integrate_exposure
from optsim.optics.panel import PanelResponse, settled_panel, slot_weights, switched
from optsim.optics.radau import middles, radau

SLOT_S, SIGMA = 1 / 180, 0.12
SIDE = (6, 7)


def levels_of(kind: str, n: int = 9) -> np.ndarray:
    rng = np.random.default_rng(4)
    if kind == "grey":
        return rng.choice(np.array([0, 90, 255], np.uint8), (n, *SIDE))
    return (rng.random((n, *SIDE)) < 0.4).astype(np.uint8) * np.uint8(255)


def fringe_of(levels, response, n_sub=1, model="fine", sigma=SIGMA):
    start = settled_panel(levels[0] * 0, response)
    leaks = np.full(levels.shape[2], response.leak)
    weights, after = slot_weights(levels, start, response, SLOT_S, n_sub)
    turned, begin = switched(levels, start, response)
    return FringeCorrection(turned, begin, response, SLOT_S, n_sub, leaks, sigma, 3, model), weights, after


def dense(levels, response, n_sub, steps=240):
    """Weights of fine cells, (t, y, x), from blurred retardance, time step by time step."""
    n, rows, cols = levels.shape
    nodes, shares = np.polynomial.legendre.leggauss(5)

    def blur(side):
        place = ((np.arange(3 * side)[:, None] + (nodes + 1) / 2) / 3).reshape(-1, 1)
        edges = np.concatenate([[-np.inf], np.arange(1.0, side), [np.inf]])
        return np.diff(ndtr((edges - place) / SIGMA), axis=1)

    down, across = blur(rows), blur(cols)
    delays = response.row_delays_s(rows)[:, None]
    gamma = np.zeros((rows, cols))
    # Slots that rows have turned to: the dark before the first, and after the last the first again.
    told = np.concatenate([levels, levels[:1], levels[:1] * 0])
    drives = np.array(response.field_drive)
    found = np.zeros((n * n_sub, 3 * rows, 3 * cols))
    step_s = SLOT_S / steps
    for k in range(n * steps):
        slot, at = divmod(k, steps)
        reached = np.floor(((k + 0.5) * step_s - delays) / SLOT_S).astype(int)[:, 0]
        level, drive = told[reached, np.arange(rows)], drives[reached % len(drives)][:, None]
        target = drive * response.white_rad * (level / 255) ** 1.2
        tau = np.where(target > gamma, response.tau_on_s, response.tau_off_s)
        now, gamma = (target + (gamma - target) * np.exp(-part * step_s / tau) for part in (0.5, 1.0))
        light = np.sin(down @ now @ across.T / 2) ** 2
        means = np.einsum("yaxb,a,b->yx", light.reshape(3 * rows, 5, 3 * cols, 5), shares / 2, shares / 2)
        found[slot * n_sub + at * n_sub // steps] += means * n_sub / steps
    return response.leak + (1 - response.leak) / response.white * found


@pytest.mark.parametrize(
    ("kind", "change", "n_sub"),
    [
        ("random", {}, 1),
        ("grey", {"field_drive": (1.03, 1.0, 0.97)}, 1),
        ("random", {"delay_s": SLOT_S / 5, "scan_s": 0.05 * SLOT_S}, 1),
        ("random", {"delay_s": SLOT_S / 5}, 4),
        ("random", {"delay_s": -SLOT_S / 40, "scan_s": 0.05 * SLOT_S}, 1),
        ("grey", {"delay_s": -SLOT_S / 5, "field_drive": (1.03, 1.0, 0.9)}, 4),
    ],
)
def test_cells_are_those_of_blurred_retardance(kind, change, n_sub):
    """Turns are at whole steps of the dense computation."""
    levels, response = levels_of(kind), PanelResponse(leak=0.0, **change)
    true = dense(levels, response, n_sub)
    left = {}
    for model in ("fine", "coarse"):
        fringe, weights, _ = fringe_of(levels, response, n_sub, model)
        left[model] = cell_weights(fringe, weights) - true
    mixed = np.stack([fine_image(w.astype(np.float64), border_shares(SIGMA, 3)) for w in weights])
    effect = np.std(np.repeat(np.repeat(weights, 3, 1), 3, 2) - true)
    assert np.std(left["fine"]) < 0.01 * effect
    assert np.std(left["coarse"]) < 0.05 * effect
    assert np.std(mixed - true) > 0.1 * effect


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"tau_on_s": 0.0},
        {"tau_off_s": 0.0, "delay_s": 1e-3, "scan_s": 1e-3},
        {"delay_s": -1e-3, "scan_s": 2e-3},
    ],
)
def test_loops_and_whole_arrays_find_the_same_cells(monkeypatch, change):
    fringe, weights, _ = fringe_of(levels_of("grey"), PanelResponse(**change), 2)
    few = cell_weights(fringe, weights)
    monkeypatch.setattr(fringe_module, "FEW", 0)
    np.testing.assert_allclose(cell_weights(fringe, weights), few, atol=1e-6)
    assert few.min() >= 0


@pytest.mark.parametrize("cores", [1, 2, 3])
def test_rows_of_a_tall_panel_find_the_same_in_bands(monkeypatch, cores):
    """70 rows: bands of 8 in some threads, against all rows together and against blurred retardance."""
    levels = np.random.default_rng(3).choice(np.array([0, 90, 255], np.uint8), (3, 70, 4))
    response = PanelResponse(leak=0.004, white_rad=3.6, delay_s=SLOT_S / 5)
    fringe, weights, _ = fringe_of(levels, response)
    together = cell_weights(fringe, weights)
    monkeypatch.setattr(threads, "CORES", cores)
    monkeypatch.setattr(fringe_module, "FEW", 0)
    found = cell_weights(fringe, weights)
    np.testing.assert_allclose(found, together, atol=2e-6)
    # Each further layout of the arrays would be compiled anew, for seconds of a first run.
    assert len(fill_cells.dispatcher().signatures) == 1
    plain = weights.repeat(3, axis=1).repeat(3, axis=2)
    true = dense(levels, response, 1)
    assert np.std(found - true) < 0.01 * np.std(plain - true)


@pytest.mark.parametrize("uneven", ["shown", "gamma", "scan", "level"])
def test_a_panel_is_even_only_if_all_inputs_of_the_correction_are(uneven):
    levels = np.full((2, *SIDE), 255, np.uint8)
    response = PanelResponse(leak=0.0, delay_s=1e-3, scan_s=2e-3 if uneven == "scan" else 0.0)
    fringe, weights, _ = fringe_of(levels, response)
    start = fringe.start
    here = np.s_[2:4, 2:5]
    if uneven == "shown":
        start.levels[here] = 200
    elif uneven == "gamma":
        start.retardance_rad[here] = 1.0
    elif uneven == "level":
        levels[1, 3, 3] = 0
    weights, _ = slot_weights(levels, start, response, SLOT_S)
    mixed = np.stack([fine_image(w.astype(np.float64), border_shares(SIGMA, 3)) for w in weights])
    assert np.abs(cell_weights(fringe, weights) - mixed).max() > 1e-4


@pytest.mark.parametrize("few", [0, 10**9])
def test_no_rim_is_darker_than_a_dark_pixel(monkeypatch, few):
    """Three points a pixel and fringing as wide as can be: without a floor some would be by 0.007."""
    monkeypatch.setattr(fringe_module, "FEW", few)
    response = PanelResponse(leak=0.0024)
    fringe, weights, _ = fringe_of(levels_of("random"), response, model="coarse", sigma=0.25)
    cells = cell_weights(fringe, weights)
    assert cells.min() == np.float32(0.0024)
    assert np.mean(cells == cells.min()) > 1e-3
    # Nor is any in the sum over time that still light gets: here of a panel that is dark but for a cross.
    levels = np.zeros((5, *SIDE), np.uint8)
    levels[:, 2, 2:5] = levels[:, 1:4, 3] = 255
    fringe, weights, _ = fringe_of(levels, response, model="coarse", sigma=0.25)
    still = np.ones((18, 21), np.float32)
    video = Video(18, 21, 3, SLOT_S, 1, 5, 5, lambda _: Segment(still, still, (), 5))
    found = integrate_exposure(video, 0, Shutter(weights, border_shares(0.25, 3), fringe)) / SLOT_S
    assert found.min() == pytest.approx(5 * 0.0024, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("overlap", [True, False])
def test_a_camera_has_its_fringe_correction(overlap):
    """Leak by column, light of which white is no half wave, jitter, stuck pixels, slots of the readout."""
    full = demo()
    panel = {"stuck_share": 0.1, "delay_s": SLOT_S / 5, "jitter_s": 0.2e-3, "rows": 6, "cols": 7}
    parts = {
        "modulator": full.modulator.model_copy(update=panel),
        "splitter": full.splitter.model_copy(update={"acceptance_rad": 3e-4}),
    }
    camera = full.model_copy(
        update={**parts, "panel_rows": 6, "panel_cols": 7, "overlap": overlap, "wavelength_m": 480e-9}
    )
    levels = levels_of("random", 36)
    code = ExposureCode(levels, np.zeros(SIDE, np.bool_))
    _, after = camera.shutter(code, camera.panel_at_rest(), 1)
    shutter, _ = camera.shutter(code, after, 1)
    found = cell_weights(shutter.fringe_correction, shutter.weights)
    n = 36 if overlap else 34
    assert not found[n:].any()
    assert np.ptp(camera.column_leaks) > 1e-5
    stuck, at = camera.stuck_pixels
    assert stuck.any()
    levels = np.where(stuck, at, levels)
    levels[n:] = np.where(stuck, at, 0)
    late_s = camera.modulator.lateness_s(36, camera.serial_number)
    response = camera.panel_response
    response = response.model_copy(update={"delay_s": response.delay_s + late_s, "leak": 0.0})
    # Twice: in the second frame the panel is as the first one left it.
    true = dense(np.concatenate([levels, levels]), response, 1)[36 : 36 + n]
    leak = camera.column_leaks.repeat(3)
    true = leak + (1 - leak) * true
    plain = shutter.weights[:n].repeat(3, axis=1).repeat(3, axis=2)
    # A turn that is not at a whole step of the dense computation leaves 2 %.
    assert np.std(found[:n] - true) < 0.03 * np.std(plain - true)


def test_a_border_that_stands_still_is_that_of_mixing():
    levels = np.zeros((3, *SIDE), np.uint8)
    levels[:, :, 3:] = 255
    response = PanelResponse(tau_on_s=0.0, tau_off_s=0.0, leak=0.0)
    fringe, weights, _ = fringe_of(levels, response, model="coarse")
    mixed = fine_image(weights[0].astype(np.float64), border_shares(SIGMA, 3))
    np.testing.assert_allclose(cell_weights(fringe, weights)[1], mixed, atol=2e-6)


def test_where_all_pixels_do_the_same_there_is_one_node_in_time(monkeypatch):
    levels = np.repeat(np.array([0, 255, 80, 0], np.uint8), 42).reshape(4, *SIDE)
    fringe, weights, _ = fringe_of(levels, PanelResponse())
    quadrature = []
    fill = fringe_module._fill_together
    monkeypatch.setattr(fringe_module, "_fill_together", lambda *a: quadrature.append(a[6].times) or fill(*a))
    cells = cell_weights(fringe, weights)
    assert [each.weight.tolist() for each in quadrature] == [[0]]
    np.testing.assert_allclose(cells, weights.repeat(3, 1).repeat(3, 2), rtol=1e-6)


@pytest.mark.parametrize("few", [0, 10**9])
def test_segments_blocks_and_darkness_make_the_same_exposure(monkeypatch, few):
    """Light of eight slots in one segment or in four, of which one is dark; the last slot is not coded."""
    monkeypatch.setattr(fringe_module, "FEW", few)
    rng = np.random.default_rng(8)
    response = PanelResponse(delay_s=1e-3, scan_s=0.5e-3)
    levels = levels_of("random", 8)
    fringe, weights, _ = fringe_of(levels, response, 2)
    fringe = replace(fringe, levels=levels[:7])
    weights[14:] = 0
    light = rng.random((16, 18, 21)).astype(np.float32)
    light[8:12] = 0
    nothing = np.zeros((18, 21), np.float32)

    def exposed(slots):
        def load(index):
            part = light[index * 2 * slots : (index + 1) * 2 * slots]
            blocks = (Block(0, 0, part[:, :10]), Block(10, 0, part[:, 10:])) if part.any() else ()
            return Segment(nothing, nothing, blocks, 2 * slots)

        video = Video(18, 21, 3, SLOT_S, 2, slots, 8, load)
        return integrate_exposure(video, 0, Shutter(weights, border_shares(SIGMA, 3), fringe))

    for slots in (1, 2, 4, 8):
        expected = (cell_weights(fringe, weights, slots) * light).sum(axis=0) * SLOT_S / 2
        np.testing.assert_allclose(exposed(slots), expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(("most_leak", "scale"), [(0.002, 1.0), (0.3, 0.0)])
def test_what_moves_is_lit_as_its_instants_beside_what_stands_still(monkeypatch, most_leak, scale):
    """A block that begins and ends within pixels, a corner of the panel, and 20 rows: three threads.

    Where it is still the floor acts on the sum of instants: 5e-5 of the light of a pixel that is on. Where
    leaks differ much from column to column it is more, so nothing stands still there.
    """
    rng = np.random.default_rng(9)
    levels = rng.choice(np.array([0, 90, 255], np.uint8), (5, 20, 7))
    response, leaks = PanelResponse(delay_s=1e-3), np.linspace(0.002, most_leak, 7)
    fringe = replace(fringe_of(levels, response, 2)[0], leaks=leaks)
    weights, _ = slot_weights(levels, fringe.start, response, SLOT_S, 2, leaks)
    still = np.float32(scale) * rng.random((60, 21)).astype(np.float32)
    boxes = ((7, 4, 23, 5), (10, 15, 6, 4), (58, 20, 2, 1))
    blocks = [Block(row, col, rng.normal(size=(10, *size)).astype(np.float32)) for row, col, *size in boxes]
    whole = cell_weights(fringe, weights) * still
    for block in blocks:
        _, tall, wide = block.excess.shape
        here = np.s_[:, block.row : block.row + tall, block.col : block.col + wide]
        whole[here] += cell_weights(fringe, weights)[here] * block.excess
    video = Video(60, 21, 3, SLOT_S, 2, 5, 5, lambda _: Segment(still, still, tuple(blocks), 10))
    for few in (0, 10**9):
        for module in ("fringe_correction", "integrate"):
            monkeypatch.setattr(f"optsim.optics.{module}.FEW", few)
        found = integrate_exposure(video, 0, Shutter(weights, border_shares(SIGMA, 3), fringe))
        np.testing.assert_allclose(found, whole.sum(axis=0) * SLOT_S / 2, rtol=1e-5, atol=5e-5 * SLOT_S)


@pytest.mark.parametrize("few", [0, 10**9])
@pytest.mark.parametrize("model", ["fine", "coarse"])
def test_a_lamp_that_is_hidden_while_pixels_are_open_leaves_no_negative_light(monkeypatch, few, model):
    """What is left of 1e6 in one instant of ten, or of none, and then a dark mover."""
    for module in ("fringe_correction", "integrate"):
        monkeypatch.setattr(f"optsim.optics.{module}.FEW", few)
    rng = np.random.default_rng(5)
    levels = rng.choice(np.array([0, 255], np.uint8), (10, 6, 7))
    fringe, weights, _ = fringe_of(levels, PanelResponse())
    fringe = replace(fringe, model=model)
    lamp = np.full((18, 21), 1e6, np.float32)
    for seen in (*range(0, 10, 3), None):
        mover = np.full((10, 18, 21), -1e6, np.float32)
        if seen is not None:
            mover[seen] = 0
        segment = Segment(lamp, lamp, (Block(0, 0, mover),), 10)
        video = Video(18, 21, 3, SLOT_S, 1, 10, 10, lambda _, it=segment: it)
        found = integrate_exposure(video, 0, Shutter(weights, border_shares(SIGMA, 3), fringe)) / SLOT_S
        expected = 0 if seen is None else cell_weights(fringe, weights)[seen] * 1e6
        np.testing.assert_allclose(found, expected, atol=2)  # rounding of ten times 1e6
        assert seen is None or found.min() > 0


def test_segments_of_another_number_of_instants_are_refused():
    light = np.zeros((18, 21), np.float32)
    video = Video(18, 21, 3, SLOT_S, 1, 4, 4, lambda _: Segment(light, light, (), 3))
    with pytest.raises(ValueCheckError, match="segment 0: got 3 instants, expected 4 slots of 1"):
        list(video.segments(0, 4))


def test_a_base_that_changes_is_lit_as_its_instants(monkeypatch):
    rng = np.random.default_rng(9)
    fringe, weights, _ = fringe_of(levels_of("random", 4), PanelResponse())
    segment = Segment(*rng.random((2, 18, 21)).astype(np.float32), (), 4)
    video = Video(18, 21, 3, SLOT_S, 1, 4, 4, lambda _: segment)
    whole = sum(cell_weights(fringe, weights)[t] * segment.instant(t) for t in range(4)) * SLOT_S
    for few in (0, 10**9):
        monkeypatch.setattr(fringe_module, "FEW", few)
        found = integrate_exposure(video, 0, Shutter(weights, border_shares(SIGMA, 3), fringe))
        np.testing.assert_allclose(found, whole, rtol=1e-5, atol=5e-5 * SLOT_S)


@pytest.mark.parametrize(
    "change",
    [{}, {"delay_s": 1e-3, "scan_s": 1e-3}, {"delay_s": -1e-3, "scan_s": 2e-3}, {"tau_on_s": 0.0}],
)
def test_a_panel_relaxes_in_the_dark_as_in_the_light(change):
    levels, response = levels_of("grey"), PanelResponse(**change, field_drive=(1.02, 1.0, 0.98))
    fringe, _, after = fringe_of(levels, response)
    found = relaxed(fringe, fringe.start, 0, len(levels))
    np.testing.assert_allclose(found.retardance_rad, after.retardance_rad, atol=2e-6)
    np.testing.assert_array_equal(found.levels, after.levels)
    assert found.slots_displayed == after.slots_displayed


@pytest.mark.parametrize("n", [1, 2, 4])
def test_a_radau_rule_is_right_for_polynomials(n):
    values = middles(5000) ** 3
    nodes, weights = radau(values, np.ones(5000), n)
    for degree in range(1, 2 * n + 1):
        assert weights @ nodes**degree == pytest.approx(np.mean(values**degree), rel=1e-6)
    assert weights @ nodes ** (2 * n + 2) != pytest.approx(np.mean(values ** (2 * n + 2)), rel=1e-5)
    assert nodes.min() > 0
    assert np.all(weights > 0)


@pytest.mark.parametrize("sigma", [1.1e-3, 0.02, 0.25])
@pytest.mark.parametrize("pitch", [1, 2, 3, 5])
def test_borders_of_any_width_and_grid_have_points(sigma, pitch):
    fringe, _, _ = fringe_of(levels_of("random"), PanelResponse(), sigma=sigma)
    points = replace(fringe, pitch=pitch).quadrature.nodes
    np.testing.assert_allclose(points.means.sum(axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(points.borders, border_shares(sigma, pitch), atol=0.005 + 0.2 * sigma**2)


def test_a_camera_without_fringing_needs_no_correction():
    camera = demo()
    probe = make_probe(changed(camera, PLAIN), Illumination(0.1, 90.0, 0.8), load_experiment("demo").schemes)
    size = next(each.size for each in effect_sizes(probe) if each.effect == "fringing")
    sharp = {"modulator": {"fringing_px": 0.0}}
    found = [max(probe.sizes(sharp, of))[0] for of in (compared_with("fringing"), {})]
    assert size == found[0] != found[1]
    sharp = with_effects(camera, {"fringing": "ideal"})
    code = ExposureCode(np.zeros((36, 120, 160), np.uint8), np.zeros((120, 160), np.bool_))
    assert sharp.shutter(code, None, 1)[0].fringe_correction is None
    assert camera.shutter(code, None, 1)[0].fringe_correction is not None
