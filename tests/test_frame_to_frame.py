"""What the loop hands from frame to frame and what it draws anew, against sums that share no code with it."""

from collections import Counter
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from test_scoring import flat, small

from optsim.calibration import Calibration
from optsim.camera.camera import CodedCamera
from optsim.coding import HdrMosaic, MotionAdaptive, NormalPhotography, RandomExposure
from optsim.decoding import HdrMerge, SparseCoding, Union, hdr_merge
from optsim.experiment import calibrations, loop
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Frames, capture, set_light

FRAMES = 3


def taken(experiment: Experiment) -> tuple[Frames, CodedCamera, calibrations.Calibrations]:
    """Frames of even light, with the camera and all that is known of it."""
    radiance = flat(experiment, 0.2)
    known = calibrate_all(experiment)
    camera, _ = set_light(experiment, radiance, known[experiment.calibration_choice])
    return capture(experiment, camera, camera.form_image(radiance), known), camera, known


def tail_slots(tau_s: float, slot_s: float) -> float:
    """Light that a panel of half a wave lets through after it was told to close, in open slots."""
    step = tau_s / 1000
    gamma = np.pi * np.exp(-np.arange(0, 20 * tau_s, step) / tau_s)
    return float((np.sin(gamma / 2) ** 2).sum() * step / slot_s)


def test_a_frame_begins_with_what_the_frame_before_left_open() -> None:
    """Of the mosaic, whoever has one open slot had all 36 in the frame before: its tail counts twice."""
    experiment = small("camera.effects.all=ideal", "camera.modulator.tau_off_s=2 ms", n_frames=FRAMES)
    mosaic = tuple(method for method in experiment.methods if method.name == "hdr_mosaic")
    frames, camera, known = taken(experiment.model_copy(update={"methods": mosaic}))
    calibration = known[experiment.calibration_choice]
    tail = tail_slots(2e-3, camera.slot_s)
    assert tail > 0.2
    for before, frame in zip(frames["hdr_mosaic"][:-1], frames["hdr_mosaic"][1:], strict=True):
        opened, earlier = (np.count_nonzero(each.code.levels, axis=0) for each in (frame, before))
        assert set(earlier[opened == 1]) == {36}
        light = frame.dn[calibration.centre_row, calibration.centre_col] - calibration.black_dn
        slots = 36 * np.array([light[opened == n].mean() for n in (1, 3, 11)]) / light[opened == 36].mean()
        # 192 pixels each, of 2000 electrons and more: 0.2 % and less of noise, and the corners' shading.
        np.testing.assert_allclose(slots, [1 + 2 * tail, 3 + tail, 11 + tail], rtol=0.01)


def test_no_two_frames_share_their_photons() -> None:
    """Differences have the noise of both frames, between the frames of a method and between methods."""
    experiment = small("camera.effects.all=ideal", n_frames=FRAMES)
    normal = next(method for method in experiment.methods if method.name == "normal")
    methods = tuple(normal.model_copy(update={"name": name}) for name in ("one", "other"))
    frames, camera, known = taken(experiment.model_copy(update={"methods": methods}))
    calibration = known[experiment.calibration_choice]
    row, col = calibration.centre_row[calibration.valid], calibration.centre_col[calibration.valid]
    light = [frame.dn[row, col].astype(float) for name in ("one", "other") for frame in frames[name]]
    expected = 2 * (np.mean(light) - calibration.black_dn.mean()) / camera.sensor.step_e
    for one, other in combinations(light, 2):
        # Five standard errors of the variance of so many pixels.
        assert np.var(one - other) == pytest.approx(expected, rel=5 * np.sqrt(2 / one.size))


def test_every_draw_has_its_own_numbers_and_another_seed_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """One bench, one code for all methods, photons of each frame and method: claims over seeds need it."""
    given, drawn = loop.stream, []

    def noted(*purpose: Any) -> np.random.Generator:
        drawn.append(given(*purpose).random())
        return given(*purpose)

    for drawing in (loop, calibrations):
        monkeypatch.setattr(drawing, "stream", noted)
    monkeypatch.setattr(calibrations, "measure_bench", lambda _, rng: rng.random())
    monkeypatch.setattr(calibrations, "bench_calibration", lambda *given: given[-1]())
    runs = []
    for seed in (1, 2, 1):
        experiment = small("camera.effects.all=ideal", f"seed={seed}", n_frames=FRAMES)
        bench = calibrations.calibrate(experiment, experiment.calibration_choice._replace(operator="bench"))
        still = tuple(method for method in experiment.methods if method.name in ("normal", "random"))
        frames, *_ = taken(experiment.model_copy(update={"methods": still}))
        arrays = [bench, frames["random"][0].code.levels, *(f.dn for name in frames for f in frames[name])]
        runs.append((set(drawn), [np.asarray(array) for array in arrays]))
        drawn.clear()
    (one, first), (other, second), (again, third) = runs
    assert len(one) == len(other) == 2 + 2 * FRAMES
    assert not one & other
    assert one == again
    for a, b, c in zip(first, second, third, strict=True):
        assert np.array_equal(a, c)
        assert not np.array_equal(a, b)


def test_scheme_and_decoder_of_a_method_know_what_the_method_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """The adaptive scheme hands its own on to the two codes that it is made of."""
    others = ("methods.normal.calibration=ideal", "methods.random.calibration=ideal")
    experiment = small("camera.effects.all=ideal", *others, n_frames=1)
    told: list[tuple[type, str]] = []

    def noted(function: Any) -> Any:
        def called(part: Any, *given: Any) -> Any:
            told.extend((type(part), each.source) for each in given if isinstance(each, Calibration))
            return function(part, *given)

        return called

    for kind in (NormalPhotography, RandomExposure, HdrMosaic, MotionAdaptive):
        monkeypatch.setattr(kind, "init", noted(kind.init))
    frames, _, known = taken(experiment)
    assert Counter(told) == {
        (MotionAdaptive, "true"): 1,
        (HdrMosaic, "true"): 2,
        (RandomExposure, "true"): 1,
        (RandomExposure, "ideal"): 1,
        (NormalPhotography, "ideal"): 1,
    }
    told.clear()
    for kind in (Union, HdrMerge, SparseCoding):
        monkeypatch.setattr(kind, "decode", noted(lambda *_: iter([None])))
    next(loop.decode(experiment, frames, known))
    names = ["adaptive", "normal", "hdr_mosaic", "random"]
    assert [method.name for method in experiment.methods] == names
    assert told == [(Union, "true"), (HdrMerge, "ideal"), (HdrMerge, "true"), (SparseCoding, "ideal")]


def test_a_frame_decoded_alone_is_as_among_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames that nobody reads are only remembered: no image of them is merged, and none is missed."""
    experiment = small("camera.effects.all=ideal", n_frames=FRAMES)
    frames, _, known = taken(experiment)
    every = list(loop.decode(experiment, frames, known))[-1].videos
    merges = 0
    given = hdr_merge.merged

    def counted(*of: Any) -> Any:
        nonlocal merges
        merges += 1
        return given(*of)

    monkeypatch.setattr(hdr_merge, "merged", counted)
    (alone,) = loop.decode(experiment, frames, known, first=FRAMES - 1)
    assert merges == sum(not isinstance(method.decoder, SparseCoding) for method in experiment.methods)
    for name, video in alone.videos.items():
        for field in ("irradiance_w_m2", "valid", "interpolated", "moving", "uncertainty_w_m2"):
            np.testing.assert_array_equal(getattr(video, field), getattr(every[name], field), err_msg=name)
