"""Schemes at f-numbers of their own: which they get, how much light that is, and what stays common."""

import numpy as np
import pytest

from optsim.experiment import Experiment, load_experiment
from optsim.loop import run
from optsim.own_f_number import THIRD_STOPS, OwnLight, at_f_number, compare, open_share, own_f_number
from optsim.quantities import Bools, CodedFrame, ExposureCode, RadianceVideo
from optsim.scene.footage import footage
from optsim.scoring import Scorer, score

ROWS, COLS = 24, 32


def small(*names: str) -> Experiment:
    experiment = load_experiment(
        "demo",
        [
            "n_frames=3",
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={3 * ROWS + 8}",
            f"camera.sensor.cols={3 * COLS + 8}",
            "calibration=true",
            "camera.relay.field_error=0.2",  # the finest would take most of these tests' time
            "methods.adaptive.decoder.moving.kind=interpolation",
            "methods.random.decoder.kind=interpolation",
            "methods.random.scheme.bump_slots=12",  # of three, the lens would not open far enough
            "save_reconstructions=[]",
        ],
    )
    methods = tuple(method for method in experiment.methods if method.name in names)
    return experiment.model_copy(update={"methods": methods})


def texture(experiment: Experiment, scale: float) -> RadianceVideo:
    """A still texture with a bar that crosses it."""
    still = np.random.default_rng(0).uniform(0.02, 0.15, (ROWS // 2, COLS // 2))
    frames = np.repeat(np.kron(still, np.ones((6, 6)))[None], experiment.timing.n_slots, 0)
    for slot in range(len(frames)):
        frames[slot, 24:42, 10 + slot // 4 : 22 + slot // 4] = 0.2
    scaled = (scale * frames).astype(np.float32)
    return footage(scaled, slot_s=experiment.timing.slot_s, samples_per_pitch=3, white_w_m2_sr=0.4)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return small("adaptive", "normal", "hdr_mosaic", "random")


@pytest.fixture(scope="module")
def shared_transmission(experiment: Experiment) -> float:
    """What the rule asks for of the texture as it is."""
    one = experiment.model_copy(update={"n_frames": 1})
    return run(one, texture(one, 1.0)).light.wanted_transmission


@pytest.fixture(scope="module")
def masks() -> list[float]:
    """f-numbers of the cameras whose oracle masks were asked for."""
    return []


@pytest.fixture(scope="module")
def compared(experiment: Experiment, shared_transmission: float, masks: list[float]) -> OwnLight:
    """At a light of which the shared f-number needs 0.9."""
    radiance = texture(experiment, shared_transmission / 0.9)
    found = Scorer.moving

    def noted(scorer: Scorer, index: int) -> Bools:
        masks.append(scorer.camera.objective.f_number)
        return found(scorer, index)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Scorer, "moving", noted)
        return compare(experiment, lambda _: radiance)


@pytest.mark.parametrize(
    ("wanted", "share", "stop"),
    [
        (1.0, 1.0, 8.0),
        (0.8, 1.0, 8.0),  # a third of a stop is 0.79
        (0.79, 1.0, 8 * 2 ** (1 / 6)),
        (1.01, 1.0, 8 / 2 ** (1 / 6)),
        (1.0, 1 / 4, 4.0),
        (1.0, 1 / 12, 2 ** (7 / 6)),  # sqrt 12 is 3.46; f/2.31 lies between f/2.24 and f/2.52
        (1e6, 1.0, 2**0.5),
        (1e-6, 1.0, 16.0),
    ],
)
def test_the_f_number_is_the_slowest_third_stop_with_light_enough(wanted, share, stop) -> None:
    assert own_f_number(8.0, wanted, share) == pytest.approx(stop, rel=1e-12)


def test_third_stops_go_from_1_4_to_16() -> None:
    assert (THIRD_STOPS[0], THIRD_STOPS[-1]) == pytest.approx((2**0.5, 16.0))
    np.testing.assert_allclose(np.diff(np.log2(THIRD_STOPS)), 1 / 6)


def test_the_fullest_pixel_of_any_frame_counts() -> None:
    def frame(index: int, n_open: int) -> CodedFrame:
        levels = np.zeros((36, 2, 2), np.uint8)
        levels[:n_open, index, 0] = 1 + index
        code = ExposureCode(levels, np.zeros((2, 2), np.bool_))
        return CodedFrame(index, np.zeros((6, 6), np.uint16), code)

    assert open_share((frame(0, 3), frame(1, 9))) == 9 / 36


def test_the_relay_opens_with_the_lens_and_never_closes(experiment: Experiment) -> None:
    fast, slow = (at_f_number(experiment, stop, ["random"]) for stop in (1.4, 11.0))
    for each in (fast, slow):
        assert [method.name for method in each.methods] == ["random"]
        panel_f_number = each.camera.objective.working_f_number
        assert each.camera.relay.accepted_share(panel_f_number) == pytest.approx(1)
    assert fast.camera.relay.f_number < experiment.camera.relay.f_number == slow.camera.relay.f_number


def test_every_scheme_fills_the_well_as_the_rule_says(compared: OwnLight, shared_transmission: float) -> None:
    assert compared.open_shares == {"adaptive": 1, "normal": 1, "hdr_mosaic": 1, "random": 12 / 36}
    for name in ("adaptive", "normal", "hdr_mosaic"):
        assert compared.f_numbers[name] == pytest.approx(4)
    assert compared.f_numbers["random"] == pytest.approx(2 ** (7 / 6))
    assert compared.filled == pytest.approx(dict.fromkeys(compared.filled, 0.8), rel=1e-6)


def test_a_scheme_of_short_exposures_gets_as_many_photons_more_as_it_was_open_less(
    experiment: Experiment, compared: OwnLight, shared_transmission: float
) -> None:
    """Three times, but for noise and a sharper image, whose percentile is brighter against its mean."""
    at_one = small("random")
    alone = run(at_one, texture(at_one, shared_transmission / 0.9))
    frames = alone.frames["random"]
    pixel = alone.calibration
    raw = np.stack([frame.dn[pixel.pick_row, pixel.pick_col][pixel.valid] for frame in frames])
    shared_e = float(np.mean((raw - pixel.black_dn[pixel.valid]) / pixel.dn_per_e))
    assert compared.mean_e["random"] / shared_e == pytest.approx(3, rel=0.05)


def test_where_all_ask_for_the_shared_f_number_the_scores_are_those_of_a_run(
    shared_transmission: float,
) -> None:
    alike = small("adaptive", "normal", "hdr_mosaic")
    radiance = texture(alike, shared_transmission / 0.9)
    compared = compare(alike, lambda _: radiance)
    assert set(compared.f_numbers.values()) == {4.0}
    assert compared.scores == score(run(alike, radiance))


def test_each_is_compared_with_the_light_on_its_own_panel(compared: OwnLight) -> None:
    """The shared camera's is 1.6 stops less."""
    errors = {
        record["region"]: record["value"]
        for record in compared.scores
        if record["method"] == "random" and record["unit"] == "stops"
    }
    assert 0 < errors["all"] < 1


def test_all_are_scored_on_the_same_pixels(compared: OwnLight, masks: list[float]) -> None:
    assert masks == [4.0] * 3, "regions are those of the camera that all would share"
    counts: dict[tuple[str, str, str], set[int]] = {}
    for record in compared.scores:
        key = (record["metric"], record["region"], record["phase"])
        counts.setdefault(key, set()).add(record["n"])
    assert counts
    assert all(len(n) == 1 for n in counts.values())
