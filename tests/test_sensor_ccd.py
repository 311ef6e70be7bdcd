from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from optsim.camera.effects import changed
from optsim.camera.hardware import demo, icx674, imx174, prototype
from optsim.camera.parts import Ccd
from optsim.core import threads


def plain(**changes) -> Ccd:
    """The ICX674 without fixed patterns, bend and smear, small."""
    off = ("prnu", "dsnu_e", "bend_at_full_well", "smear_share")
    return icx674().model_copy(update={"rows": 300, "cols": 400} | dict.fromkeys(off, 0.0) | changes)


def frame(sensor, electrons, seed=0):
    return sensor.digitise(
        np.full((sensor.rows, sensor.cols), float(electrons)), 0.2, 1, np.random.default_rng(seed)
    )


@pytest.mark.parametrize("electrons", [0.0, 5.0, 300.0, 9000.0])
def test_mean_and_variance_follow_the_photon_transfer_equation(electrons):
    sensor = plain()
    n = sensor.rows * sensor.cols
    dn = frame(sensor, electrons)[0].astype(np.float64)
    variance = (electrons + sensor.read_noise_e**2) / sensor.gain_e**2 + 1 / 12
    # 4.5 sigma two-sided: seven false alarms in a million runs for each of these eight comparisons.
    mean_sigma, variance_sigma = np.sqrt(variance / n), variance * np.sqrt(2 / n)
    assert dn.mean() == pytest.approx(64 + electrons / 0.96, abs=4.5 * mean_sigma)
    assert dn.var() == pytest.approx(variance, abs=4.5 * variance_sigma)


def test_a_full_pixel_clips_at_the_well_and_not_beyond():
    sensor = plain()
    dn, _ = frame(sensor, 40_000)
    expected = 15770 / 0.96 + 64
    assert dn.max() <= sensor.max_dn
    # The well lies above the converter's range less the black level: whichever comes first.
    assert dn.mean() == pytest.approx(min(expected, sensor.max_dn), abs=3)
    deep = plain(bits=16)
    dn, _ = frame(deep, 40_000)
    assert dn.mean() == pytest.approx(expected, abs=4.5 * 9.8 / np.sqrt(dn.size) + 1e-3)
    assert dn.std() == pytest.approx(9.39 / 0.96, rel=0.02)  # only read noise is left


@pytest.mark.parametrize("bits", [8, 12, 14, 16])
@pytest.mark.parametrize("wells", [1.1, 2.0, 1e3, 1e9])
@pytest.mark.parametrize("make", [icx674, imx174])
def test_a_saturated_pixel_reads_the_well_or_the_converters_end_exactly(make, wells, bits):
    quiet = {"rows": 16, "cols": 5, "read_noise_e": 0.0, "dsnu_e": 0.0, "smear_share": 0.0, "bits": bits}
    sensor = make().model_copy(update=quiet)
    dn, _ = frame(sensor, wells * sensor.full_well_e)
    well_dn = sensor.full_well_e * (1 - sensor.bend_at_full_well) / sensor.gain_e + sensor.black_dn
    assert (dn == min(round(well_dn), 2**bits - 1)).all()


def test_more_light_never_reads_less_even_when_smear_passes_the_well_many_times():
    few = {"rows": 16, "cols": 5, "readout_rows": None}
    sensor = icx674().model_copy(update=few | {"read_noise_e": 0.0, "dsnu_e": 0.0})
    well_dn = sensor.full_well_e * (1 - sensor.bend_at_full_well) / sensor.gain_e + sensor.black_dn
    seen = [frame(sensor, wells * sensor.full_well_e)[0].min() for wells in 10.0 ** np.arange(1, 10)]
    assert seen == sorted(seen)
    assert well_dn - 1 <= seen[0] <= sensor.max_dn
    assert seen[-1] == sensor.max_dn


def test_the_bend_is_what_the_data_sheet_instance_says():
    sensor = icx674()
    full = sensor.full_well_e
    missing = 1 - sensor.bent(np.array([0.8 * full, full])) / np.array([0.8 * full, full])
    assert missing[0] < 0.01
    assert missing[1] == pytest.approx(0.03)


def test_fixed_patterns_belong_to_a_serial_number_and_have_their_stated_size():
    sensor = icx674()
    one, again, other = (sensor.pixel_response(s) for s in (1, 1, 2))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)
    # Millions of pixels: 1 % of the rms is more than twenty sigma.
    assert one.std() == pytest.approx(0.008, rel=0.01)
    assert sensor.dark_signal_e(1).std() == pytest.approx(1.5, rel=0.01)


def test_dark_current_doubles_with_every_seven_degrees_and_holds_at_the_data_sheets():
    sensor = icx674()
    assert sensor.dark_rate_e_s == sensor.dark_current_e_s
    warm = sensor.model_copy(update={"temperature_c": 46.0})
    assert warm.dark_rate_e_s == pytest.approx(8 * sensor.dark_current_e_s)
    # And it is what a camera counts: everything dark, a fifth of a second.
    camera = prototype().model_copy(update={"sensor": warm})
    assert camera.dark_e == pytest.approx(8 * 1.27 * 0.2, rel=1e-6)
    assert camera.ledger(1.0) != prototype().ledger(1.0)


def test_negative_light_is_counted_and_taken_as_dark():
    sensor = plain(rows=4, cols=5)
    expected = np.zeros((4, 5))
    expected[1, 2], expected[3, 3] = -4.0, -1e-9  # the second is rounding
    dn, count = sensor.digitise(expected, 0.2, 1, np.random.default_rng(0))
    assert count == 1
    assert dn[1, 2] > 0


def test_the_same_generator_gives_the_same_frame():
    sensor = plain(rows=20, cols=30)
    assert np.array_equal(frame(sensor, 100, 5)[0], frame(sensor, 100, 5)[0])
    assert not np.array_equal(frame(sensor, 100, 5)[0], frame(sensor, 100, 6)[0])


def test_data_sheet_instances_reproduce_their_own_derived_figures():
    ccd = icx674()
    # 63.9 dB from 14 693 e- and 9.39 e- (EMVA counts half a bit of threshold differently): within 1 dB.
    assert 20 * np.log10(ccd.full_well_e / ccd.read_noise_e) == pytest.approx(63.9, abs=1)
    cmos = imx174()
    assert 20 * np.log10(cmos.full_well_e / cmos.read_noise_e) == pytest.approx(73, abs=0.5)


def test_dark_electrons_are_not_smeared():
    sensor = plain(rows=100, cols=6, smear_share=1e-3, dark_current_e_s=1000.0)
    expected = np.full((100, 6), 200.0)
    assert np.abs(sensor.smear_e(expected, 0.2)).max() < 1e-9
    expected[50, 2] += 5e6
    of_light = plain(rows=100, cols=6, smear_share=1e-3, dark_current_e_s=0.0).smear_e(expected - 200, 0.2)
    np.testing.assert_allclose(sensor.smear_e(expected, 0.2), of_light, atol=1e-9)


def test_smear_is_the_column_sum_times_shield_and_dwell_and_passes_a_full_well():
    sensor = plain(
        rows=100, cols=6, smear_share=1e-3, readout_s=0.04, readout_rows=100, read_noise_e=0.0, gain_e=1.1
    )
    expected = np.zeros((100, 6))
    expected[20:40, 3] = 1000 * sensor.full_well_e
    expected[10, 1] = 1.0
    smear = sensor.smear_e(expected, 0.2)
    # 20 rows of 1000 wells, through a shield of 0.1 %, each for 0.04 s / 100 of 0.2 s.
    assert smear[3] == pytest.approx(20 * 1000 * sensor.full_well_e * 1e-3 * 0.04 / 100 / 0.2)
    seen = np.stack([sensor.digitise(expected, 0.2, 1, np.random.default_rng(i))[0] for i in range(40)])
    seen = (seen - sensor.black_dn) * sensor.gain_e
    dark = np.r_[:20, 40:100]
    # 3200 Poisson samples of 631 electrons: the mean within 5 x 0.44, the variance within 5 x 2.5 %.
    assert seen[:, dark, 3].mean() == pytest.approx(smear[3], abs=2.5)
    assert seen[:, dark, 3].var() == pytest.approx(smear[3], rel=0.13)
    assert np.abs(seen[:, :, [0, 2, 4, 5]]).max() < 1
    assert seen[0, 20:40, 3].min() > sensor.full_well_e
    none = sensor.model_copy(update={"smear_share": 0.0})
    assert not none.smear_e(expected, 0.2).any()


def test_a_region_of_interest_is_read_as_fast_a_row_as_the_whole_chip():
    whole, region = icx674(), icx674().model_copy(update={"rows": 360})
    assert whole.frame_readout_s == pytest.approx(39.1e-3, rel=1e-12)
    assert region.frame_readout_s == pytest.approx(39.1e-3 / 4, rel=1e-12)
    # As many lit rows smear as much, whatever is read around them: each dwells 27.2 us in a row.
    for sensor in (whole, region):
        light = np.zeros((sensor.rows, 2))
        light[100:120, 1] = 5e6
        smear_e = sensor.smear_e(light + sensor.dark_rate_e_s * 0.2, 0.2)
        assert smear_e[1] == pytest.approx(1e-3 * 20 * 5e6 * (39.1e-3 / 1440) / 0.2, rel=1e-9)
    own = region.model_copy(update={"readout_s": 0.01, "readout_rows": None})
    assert own.frame_readout_s == pytest.approx(0.01, rel=1e-12)


def flat_frames(sensor, electrons, count, seed):
    """Frames of a flat, each with a stream of its own as the loop gives them, (frame, y, x), DN."""
    streams = np.random.default_rng(seed).spawn(count)
    expected = np.full((sensor.rows, sensor.cols), float(electrons))
    return np.stack([sensor.digitise(expected, 0.2, 1, rng)[0] for rng in streams]).astype(np.float64)


def test_pixels_respond_before_shot_noise_so_each_has_the_noise_of_its_own_electrons():
    sensor = plain(rows=100, cols=150, prnu=0.1)
    camera = prototype().model_copy(update={"sensor": sensor})
    electrons, count = 7000.0, 60
    uneven = camera.photon_electrons(np.ones((100, 150)))
    expected = uneven * (electrons * sensor.pixel_response(camera.serial_number).mean() / uneven.mean())
    streams = np.random.default_rng(3).spawn(count)
    dn = np.stack([sensor.digitise(expected, 0.2, camera.serial_number, rng)[0] for rng in streams])
    variance = dn.astype(np.float64).var(axis=0, ddof=1) * sensor.gain_e**2
    response = sensor.pixel_response(camera.serial_number).astype(np.float64)
    slope = np.polyfit(response.ravel(), variance.ravel(), 1)[0]
    # Var = e r + read^2. Response after the noise would give e r^2: a slope of twice that. 4.5 sigma
    # two-sided of 15 000 variances of 60 frames, some 7 % of the slope: seven false alarms in a million.
    sigma = (electrons + sensor.read_noise_e**2) * np.sqrt(2 / (count - 1) / response.size) / response.std()
    assert slope == pytest.approx(electrons, abs=4.5 * sigma)


@pytest.mark.parametrize("electrons", [0.0, 5000.0])
def test_noise_is_white_over_frames_rows_and_columns(electrons):
    # 16 rows a strip of noise: the lags between strips, frames and neighbours are all among those tested.
    dn = flat_frames(plain(rows=128, cols=150), electrons, 24, 11)
    noise = (dn - dn.mean()) / dn.std()
    power = np.abs(np.fft.fftn(noise)) ** 2
    correlation = np.fft.ifftn(power).real.ravel() / noise.size
    lags = correlation[1 : noise.size // 2] * np.sqrt(noise.size)  # the other half mirrors it
    # Of white noise each is standard normal. Largest of 230 000: 6 sigma has 1 false alarm in 2000.
    assert np.abs(lags).max() < 6
    # Their mean square is 1, two-sided at 4.5 sigma: seven false alarms in a million.
    assert (lags**2).mean() == pytest.approx(1, abs=4.5 * np.sqrt(2 / lags.size))


def test_frames_do_not_depend_on_threads_nor_on_the_order_in_which_they_are_taken(monkeypatch):
    sensor = icx674().model_copy(update={"rows": 61, "cols": 40})  # strips of unequal height
    expected = np.random.default_rng(0).uniform(0, 20_000, (61, 40))

    def take(index):
        return sensor.digitise(expected, 0.2, 1, np.random.default_rng([5, index]))[0]

    frames = [take(index) for index in range(12)]
    for cores in (1, 2, 7):
        monkeypatch.setattr(threads, "CORES", cores)
        assert np.array_equal(take(4), frames[4])
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(take, reversed(range(12))))
    assert np.array_equal(together[::-1], frames)


@pytest.mark.parametrize(
    ("update", "cure"),
    [
        ({"black_dn": 20000}, "black_dn: got 20000, expected less than 16383"),
        ({"gain_e": 1e-3}, "gain_e: got 0.001, .* end at 16.3 electrons; expected 93.9 or more"),
    ],
)
def test_a_converter_that_shows_no_light_is_refused(update, cure):
    with pytest.raises(ValueError, match=cure):
        Ccd.model_validate(demo().sensor.model_dump() | update)


def test_a_pixel_clips_by_its_well_or_by_the_converter():
    sensor = demo().sensor
    assert sensor.range_e == pytest.approx((16383 - 64) * 0.96)
    narrow = sensor.model_copy(update={"gain_e": 0.3})
    assert narrow.most_e == pytest.approx((16383 - 64) * 0.3)
    wide = sensor.model_copy(update={"gain_e": 10.0})
    assert wide.most_e == wide.full_well_e
    camera = changed(demo(), {"sensor": {"gain_e": 0.3}})
    told = {row.stage: row.value for row in camera.ledger(0.18)}
    assert told["of the converter's range: clips"] == pytest.approx(
        told["electrons a frame"] / camera.sensor.range_e
    )
    assert told["SNR of a frame, centre pixel: clips"] < camera.sensor.most_e**0.5
