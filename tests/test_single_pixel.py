"""Table 1's single-pixel camera, hypothetical here: light, causality and its row in figure 4."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from programs import program
from small_experiment import SMALL

from optsim.core.quantities import Block, Segment
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import Frames, Result, run
from optsim.footage.made import footage

PLACE = Path(__file__).parent.parent / "validation"
FRAMES = 6  # the last is steady
NAME = "single_pixel"


@pytest.fixture(scope="module")
def single() -> ModuleType:
    module = program("single_pixel")
    module.BLOCKS = 6  # of 3 x 3 panel pixels, the last column of 3 x 1
    return module


@pytest.fixture(scope="module")
def result() -> Result:
    """A run of a flat scene whose right half is brighter, and slowly becomes more so."""
    experiment = load_experiment("figure4", [*SMALL, f"n_frames={FRAMES}", "calibration=true"]).only(
        ["adaptive"]
    )
    n = experiment.timing.n_slots
    frames = np.full((n, 36, 48), 0.1, np.float32)
    frames[:, :, 24:] = np.linspace(0.2, 0.3, n)[:, None, None]
    return run(
        experiment, footage(frames, slot_s=experiment.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4)
    )


@pytest.fixture(scope="module")
def both(single: ModuleType, result: Result) -> Result:
    return single.with_single_pixel(result)


def test_light_is_in_its_unit_and_where_it_was(both: Result) -> None:
    video = both.reconstructions[NAME][-1]
    light, truth = video.irradiance_w_m2, both.reference(FRAMES - 1)
    assert light.shape == truth.shape
    assert light.mean() == pytest.approx(truth.mean(), rel=0.02)
    for half in (np.s_[:, :, :6], np.s_[:, :, 9:]):
        assert light[half].mean() == pytest.approx(truth[half].mean(), rel=0.05)
    assert video.valid.all()
    assert not video.interpolated.any()


def test_blocks_of_a_large_panel_hold_their_mean(single: ModuleType) -> None:
    """Sides of 5 panel pixels, those at the edges narrower."""
    image = np.random.default_rng(1).uniform(size=(2, 12, 13))
    sums = single._block_sums(image, 5)
    assert sums.shape == (2, 3, 3)
    assert sums[1, 2, 2] == pytest.approx(image[1, 10:, 10:].sum())
    assert sums.sum() == pytest.approx(image.sum())


def test_enough_readings_without_noise_give_a_still_scene_back(single: ModuleType) -> None:
    scene = 0.2 + np.random.default_rng(1).uniform(0, 0.1, (8, 8))
    scene[2:5, 3:7] = 0.6
    patterns = single.walsh_patterns(*scene.shape)
    assert np.linalg.matrix_rank(patterns.reshape(len(patterns), -1)) == scene.size
    patterns = np.tile(patterns, (2, 1, 1))
    readings = np.einsum("tyx,yx->t", patterns, scene)
    found = single.decode(readings, patterns, np.full(len(readings), 1e-12))
    np.testing.assert_allclose(found, np.broadcast_to(scene, found.shape), atol=0.01 * scene.mean())


def test_a_frame_depends_on_no_later_light(single: ModuleType, both: Result) -> None:
    truth = both.truth

    def load(index: int) -> Segment:
        segment = truth.load(index)
        if index < truth.n_segments - 1:
            return segment
        blocks = tuple(Block(b.row, b.col, 2 * b.excess) for b in segment.blocks)
        return Segment(2 * segment.start, 2 * segment.stop, blocks, segment.n_instants)

    brighter = single.with_single_pixel(replace(both, truth=replace(truth, load=load)))
    before, after = (each.reconstructions[NAME] for each in (both, brighter))
    same = [np.array_equal(a.irradiance_w_m2, b.irradiance_w_m2) for a, b in zip(before, after, strict=True)]
    # The last segment lies in the last frame.
    assert same == [True] * (FRAMES - 1) + [False]


def test_figure_4_has_its_row_and_no_claim_is_judged_by_it(both: Result) -> None:
    claims = program("claims")
    scene = claims.judged([claims._found(both, 0)])
    assert f"| {NAME} | " in claims.figure4({1: {"half": scene}})
    assert all(verdict.rival is None for verdict in scene["verdicts"])


def test_at_another_latency_it_is_taken_over(both: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing tries to take its coded frames, of which it has none."""
    claims, asked = program("claims"), []

    def capture(part: Experiment, *_: object) -> Frames:
        asked.extend(each.name for each in part.methods)
        return both.frames

    monkeypatch.setattr(claims, "capture", capture)
    monkeypatch.setattr(claims, "decode", lambda *_: ())
    assert claims.at_latency(both, 2).reconstructions[NAME] is both.reconstructions[NAME]
    assert asked == ["adaptive"]


@pytest.mark.parametrize("wavelet", ["Haar", "LeGall"])
def test_an_adaptive_scan_finds_the_edges_of_measured_wavelets(wavelet: str) -> None:
    measured = program("single_pixel_measured")
    y, x = np.mgrid[:32, :32] - 15.7
    disc = (np.hypot(y, x) < 9).astype(np.float64)
    coefficients = disc.copy()
    for n in (32, 16):
        analysis = np.linalg.inv(measured._synthesis(n, wavelet))
        coefficients[:n, :n] = analysis @ coefficients[:n, :n] @ analysis.T
    np.testing.assert_allclose(measured.picture(coefficients, 8, wavelet), disc, atol=1e-12)

    def error(kept: np.ndarray) -> float:
        return float(np.square(measured.picture(kept, 8, wavelet) - disc).mean())

    few = measured.adaptive_scan(coefficients, 8, wavelet, (0.5, 0.25))
    assert np.count_nonzero(few) <= 64 + 96 + 192
    coarse = measured.adaptive_scan(coefficients, 8, wavelet, (0.0, 0.0))
    assert error(few) < 0.35 * error(coarse)
    to_ccd = np.array([[1.0, 0, 2], [0, 1, 3], [0, 0, 1]])
    moved = np.zeros_like(disc)
    moved[3:, 2:] = disc[:-3, :-2]
    assert measured.real_psnr(disc, to_ccd, 5 + 7 * moved) > 100
