"""State that schemes and decoders carry from frame to frame, and what they do where pixels saturate."""

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from ideal_camera import expose, film, ideal_calibration, still_light
from test_scoring import COLS, ROWS, flat, small

from optsim.calibration import demixed
from optsim.calibration.demixed import SaturationPrior, next_demixed_frame
from optsim.camera.true_calibration import true_calibration
from optsim.coding import MotionAdaptive, NormalPhotography, RandomExposure, change_test
from optsim.core.quantities import ExposureCode, PanelState
from optsim.decoding import HdrMerge, SparseCoding, Union
from optsim.decoding.partial import Partial
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.loop import capture, set_light

V, U = 24, 24


def scene(value: float, patch: float | None = None) -> np.ndarray:
    image = np.full((V, U), value, np.float32)
    if patch is not None:
        image[8:16, 8:16] = patch
    return still_light(image)


@pytest.mark.parametrize("taker", [HdrMerge(), SparseCoding(stride_px=8), MotionAdaptive()])
def test_the_panel_of_a_frame_is_what_the_frame_before_left(
    taker: HdrMerge | SparseCoding | MotionAdaptive, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibration = ideal_calibration(V, U, tau_s=2e-3)
    frames = film(calibration, RandomExposure(), [scene(0.2)] * 3, None)
    panels: list[PanelState | None] = []

    def spy(*given: Any) -> Any:
        panels.append(given[2])
        return next_demixed_frame(*given)

    monkeypatch.setattr(
        change_test if isinstance(taker, MotionAdaptive) else demixed, "next_demixed_frame", spy
    )
    if isinstance(taker, MotionAdaptive):
        state = taker.init(calibration, np.random.default_rng(0))
        taker.next(3, frames[:2], state)
        taker.next(4, frames, taker.next(3, frames[:2], state)[1])
        panels = panels[2:]
    else:
        list(taker.decode(frames, calibration))
    assert panels[0] is None, "an experiment begins with a cycle of its first code"
    _, panel = calibration.weights(frames[0].code, None)
    for frame, used in zip(frames[1:], panels[1:], strict=True):
        assert used is not None
        np.testing.assert_array_equal(used.retardance_rad, panel.retardance_rad)
        np.testing.assert_array_equal(used.levels, panel.levels)
        _, panel = calibration.weights(frame.code, panel)
    assert panel.retardance_rad.max() > 1, "some pixel ends a frame open"


def test_all_methods_show_the_same_random_tile() -> None:
    """Tiles differ by more than the registered margin: claims compare schemes, not the luck of a draw."""
    experiment = small()
    radiance = flat(experiment, 0.1)
    known = calibrate_all(experiment)
    camera, _ = set_light(experiment, radiance, known[experiment.calibration_choice])
    frames = capture(experiment, camera, camera.form_image(radiance), known)
    np.testing.assert_array_equal(frames["adaptive"][0].code.levels, frames["random"][0].code.levels)


def test_a_label_stays_where_nothing_can_be_compared_and_goes_where_it_can() -> None:
    calibration = ideal_calibration(V, U)
    scheme = MotionAdaptive(static=NormalPhotography(), moving=NormalPhotography(), dilation_px=0)
    state = scheme.init(calibration, np.random.default_rng(0))
    # 0.1 to 10 W m^-2 saturates; two saturated frames cannot say that it stopped.
    frames = film(calibration, scheme, [scene(0.1, p) for p in (0.1, 10, 10)], np.random.default_rng(1))
    code, seen = scheme.next(3, frames, state)
    assert code.moving[8:16, 8:16].all()
    assert not code.moving[:6].any()
    # The last real sample is kept, and no bound taken for one.
    np.testing.assert_allclose(seen.changes.seen.irradiance, 0.1, rtol=0.25)
    frames = film(calibration, scheme, [scene(0.1, p) for p in (0.1, 0.5, 0.5)], np.random.default_rng(1))
    code, _ = scheme.next(3, frames, state)
    assert not code.moving.any(), "it moved once, and stopped"


def test_neighbours_of_a_saturated_pixel_do_not_move_while_nothing_does() -> None:
    """The sun under codes of 1 : 36 leaks ever different amounts: only separation with memory knows."""
    kernel = np.array([[0, 0.01, 0], [0.01, 0.96, 0.01], [0, 0.01, 0]], np.float32)
    calibration = ideal_calibration(V, U, crosstalk=kernel, leak=0.01)
    scheme = MotionAdaptive(first_frames="static")
    frames = film(calibration, scheme, [scene(0.5, 20)] * 7, np.random.default_rng(2))
    assert not any(f.code.moving.any() for f in frames)


def test_a_patch_in_the_sun_is_bright_in_the_sparse_decoder() -> None:
    calibration = ideal_calibration(V, U)
    frames = film(calibration, RandomExposure(), [scene(100.0)], np.random.default_rng(3))
    video = next(iter(SparseCoding(stride_px=4).decode(frames, calibration)))
    bound = (15_000 - 64) / 270 / 3
    assert np.median(video.irradiance_w_m2) > 0.7 * bound


def test_the_sparse_decoder_remembers_what_a_saturated_pixel_gave(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[SaturationPrior] = []

    def spy(*taken: Any) -> Any:
        given.append(taken[3])
        return next_demixed_frame(*taken)

    monkeypatch.setattr(demixed, "next_demixed_frame", spy)
    calibration = ideal_calibration(V, U)
    frames = film(calibration, RandomExposure(), [scene(0.5), scene(0.5, 100), scene(0.5)], None)
    list(SparseCoding(stride_px=8).decode(frames, calibration))
    assert np.isnan(given[0].irradiance).all()
    assert not given[1].floor.any()
    np.testing.assert_allclose(given[1].irradiance, 0.5, rtol=0.02)
    # A bound is no estimate.
    np.testing.assert_allclose(given[2].irradiance, 0.5, rtol=0.02)
    np.testing.assert_allclose(given[2].floor[8:16, 8:16], (15_000 - 64) / 270 / 3, rtol=0.15)
    assert not given[2].floor[:6].any()


def test_the_union_fades_from_one_branch_to_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    yes, no = np.ones((1, 4), np.bool_), np.zeros((1, 4), np.bool_)
    moving = np.array([[True, False, False, True]])
    still_valid = np.array([[True, True, True, False]])

    def layer(value: float, blend_weight: list[float], valid: np.ndarray, filled: np.ndarray) -> Any:
        def partials(_: Any, frames: Any, *__: Any) -> Iterator[Partial]:
            next(iter(frames))
            image = np.full((36, 1, 4), value, np.float32)
            yield Partial(0, image, np.array([blend_weight], np.float32), valid, filled, moving, 36)

        return partials

    monkeypatch.setattr(HdrMerge, "partials", layer(1.0, [1, 1, 1, 1], still_valid, yes))
    monkeypatch.setattr(SparseCoding, "partials", layer(3.0, [1, 0.5, 0, 1], moving, no))
    calibration = ideal_calibration(1, 4)
    frames = film(calibration, RandomExposure(), [scene(0.5)[:, :1, :4]], None)
    joined = next(iter(Union(video="coded").decode(frames, calibration)))
    np.testing.assert_allclose(joined.irradiance_w_m2[7], [[3, 2, 1, 3]])
    np.testing.assert_array_equal(joined.valid, [[True, True, True, True]])
    np.testing.assert_array_equal(joined.interpolated, [[False, False, True, False]])


def test_the_true_calibration_knows_a_clip_and_the_veil() -> None:
    experiment = small()
    camera = experiment.camera
    relay = camera.relay.model_copy(update={"ghost_share": 0.0})
    camera = camera.model_copy(update={"relay": relay})
    calibration = true_calibration(camera)
    on = ExposureCode(np.full((36, ROWS, COLS), 255, np.uint8), np.zeros((ROWS, COLS), np.bool_))
    truth = camera.form_image(flat(experiment, 100.0))
    frame, _ = camera.expose(truth, 0, on, camera.panel_at_rest(), np.random.default_rng(0))
    assert calibration.observe(frame).saturated[calibration.valid].all()
    # A quarter of the panel open: what the opposite corner sees beyond its leak is veil.
    levels = np.zeros((36, ROWS, COLS), np.uint8)
    levels[:, : ROWS // 2, : COLS // 2] = 255
    code = ExposureCode(levels, on.moving)
    truth = camera.form_image(flat(experiment, 0.2))
    rest = camera.panel_at_rest()
    seen = camera.expected_electrons(truth, 0, code, rest)[0][calibration.centre_row, calibration.centre_col]
    seen = (seen - camera.dark_e) * calibration.dn_per_e / calibration.responsivity_dn
    weights, _ = calibration.weights(code, rest)
    light = (weights * camera.reference(truth, 0)).sum(axis=0)
    far = np.s_[-6:, -8:]
    excess = (seen - calibration.spread(light[None])[0])[far].mean()
    assert excess > 0
    assert (calibration.mix(light) - calibration.spread(light[None])[0])[far].mean() == pytest.approx(
        excess, rel=0.25
    )


@pytest.mark.parametrize("side", [1, 3])
def test_a_pixel_by_itself_is_what_it_is_among_others(side: int) -> None:
    """All but crosstalk and glare; without them light reads as a pixel's own."""
    camera = small().camera
    panel = camera.modulator.model_copy(update={"stuck_share": 0.02})
    camera = camera.model_copy(update={"modulator": panel})
    whole, alone = (true_calibration(camera, side, alone=each) for each in (False, True))
    for field in fields(whole):
        if field.name in {"crosstalk", "glare"}:
            continue
        np.testing.assert_array_equal(getattr(alone, field.name), getattr(whole, field.name), field.name)
    assert not whole.valid.all()
    light = np.random.default_rng(0).random((ROWS, COLS)).astype(np.float32)
    np.testing.assert_array_equal(alone.mix(light), light)
    assert np.abs(whole.mix(light) - light).max() > 0.05


def test_the_newest_real_sample_judges_older_ones() -> None:
    """Newest frame saturated: an old frame that disagrees with a newer real sample is not merged."""
    calibration = ideal_calibration(V, U)
    schemes = [NormalPhotography(open_slots=n) for n in (9, 9, 36)]
    panel, frames = calibration.panel_at_rest(), []
    for index, (scheme, level) in enumerate(zip(schemes, (1.0, 3.0, 3.0), strict=True)):
        code, _ = scheme.next(index, [], scheme.init(calibration, np.random.default_rng(0)))
        frame, panel = expose(calibration, scene(0.2, level), index, code, panel, None)
        frames.append(frame)
    last = list(HdrMerge().decode(frames, calibration))[-1]
    np.testing.assert_allclose(last.irradiance_w_m2[0][9:15, 9:15], 3.0, rtol=0.01)
