"""Figures of a data set that a user computes with: the card's gain, and the scale of its reconstructions."""

from pathlib import Path

import numpy as np
import pytest
from small_study import load, write_experiment

from optsim.core.files import read_exr
from optsim.dataset import load_spec
from optsim.dataset.card import card
from optsim.dataset.sequence import _take


def test_the_gain_of_the_card_is_that_of_photon_transfer() -> None:
    """Electrons a DN: mean over variance of the difference of two flats, and the reading's own noise."""
    spec = load_spec("demo")
    about = card(spec, spec.sequences()[:1], {}, "exr", "", recipe=True, filters=())
    assert set(about["cameras"]) == set(spec.cameras)
    for name, said in about["cameras"].items():
        sequence = next(each for each in spec.sequences() if each.camera == name)
        sensor = spec.experiment_of(sequence, spec.seeds[0]).camera.sensor
        rng = np.random.default_rng(5)

        def pair(electrons: float, sensor=sensor, rng=rng) -> tuple[float, float]:
            flat = np.full((sensor.rows, sensor.cols), electrons)
            one, two = (sensor.digitise(flat, 5e-3, 1, rng)[0].astype(np.float64) for _ in range(2))
            return (one + two).mean() / 2, (one - two).var() / 2

        (dark, noise), (bright, variance) = pair(0.0), pair(0.3 * sensor.full_well_e)
        assert said["gain_e_per_dn"] == pytest.approx((bright - dark) / (variance - noise), rel=0.03)
        # Rounding adds a twelfth of a step.
        read = said["gain_e_per_dn"] * np.sqrt(noise - 1 / 12)
        assert said["read_noise_e"] == pytest.approx(read, rel=0.05)
        assert said["black_dn"] == pytest.approx(dark, abs=0.01 * bright)


def test_reconstructions_of_a_set_are_radiance(tmp_path: Path) -> None:
    """Against the film itself, whose radiance is half of its values (``scale_w_m2_sr``)."""
    base = load(write_experiment(tmp_path), "normal").model_copy(update={"n_frames": 1})
    spec = load_spec("demo").model_copy(update={"reconstruct": True})
    _take(base, tmp_path / "seed1", spec, draws=1, slot_error=None)
    film = np.load(tmp_path / "film.npy").astype(np.float64) / 65535
    made, _ = read_exr(tmp_path / "seed1/reconstructions/normal/000000.exr")
    video = np.stack([made[name] for name in sorted(made)]).astype(np.float64)
    # Nine samples a panel pixel; the bar passes some, the rest stands still.
    slots = 0.5 * film[:36].reshape(36, 24, 3, 32, 3).mean(axis=(2, 4))
    still = np.ptp(slots, axis=0) == 0
    assert np.median((video / slots)[:, still]) == pytest.approx(1, abs=0.05)
