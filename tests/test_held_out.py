"""A calibration against the one before, on images that neither was made from."""

from dataclasses import replace
from pathlib import Path

import pytest
from synthetic_bench import Camera

from optsim.calibration import Bench, Calibration, calibrate_from
from optsim.calibration.estimate import measure_calibration
from optsim.calibration.held_out import check_same_camera, explained, held_out
from optsim.core.errors import BenchError, ConfigError
from optsim.experiment.calibration_record import calibration_record, with_before
from optsim.report.calibration_page import CalibrationRecord

SMALL = {"panel": (30, 40), "ccd": (110, 140)}


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Camera(**SMALL).bench()


@pytest.fixture(scope="module")
def after(bench: Bench) -> Calibration:
    return calibrate_from(held_out(bench)[0])


@pytest.fixture(scope="module")
def record(bench: Bench) -> CalibrationRecord:
    return calibration_record(measure_calibration(bench), bench, Path("bench"))


def test_one_image_of_each_held_setting_is_spared_and_not_calibrated_from(bench: Bench) -> None:
    rest, spared = held_out(bench)
    assert {name.split("[")[0] for name, _ in spared} >= {"flats", "off", "dots"}
    for name, group in spared:
        assert len(group.dn) == 1
        kind, number = name.rstrip("]").split("[")
        held = getattr(rest, kind)
        kept = held[int(number)] if isinstance(held, tuple) else held
        there = getattr(bench, kind)
        whole = there[int(number)] if isinstance(there, tuple) else there
        assert len(kept.dn) == len(whole.dn) - 1
        assert (group.dn[0] == whole.dn[-1]).all()
    single = replace(bench, dots=tuple(replace(group, dn=group.dn[:1]) for group in bench.dots))
    rest, spared = held_out(single)
    assert f"dots[{len(bench.dots) - 1}]" in dict(spared)
    assert len(rest.dots) == len(bench.dots) - 1


def test_a_camera_that_has_moved_needs_the_new_calibration(
    bench: Bench, after: Calibration, record: CalibrationRecord
) -> None:
    moved = calibrate_from(Camera(**SMALL, shift=(4.3, -2.7)).bench())
    compared = explained(moved, after, held_out(bench)[1])
    found = with_before(record, compared, Path("old.npz"))
    assert found.held_out is not None
    assert found.held_out.better
    assert found.held_out.after_sigmas < 0.5 * found.held_out.before_sigmas
    assert found.remarks[0].startswith(f"{len(compared)} held-out images are")
    # The other way round, a calibration of the camera where it no longer is, is flagged.
    worse = with_before(record, explained(after, moved, held_out(bench)[1]), Path("old.npz"))
    assert worse.remarks[0].startswith("Flag: not better than before.")


def test_a_calibration_that_is_only_another_is_flagged(
    bench: Bench, after: Calibration, record: CalibrationRecord
) -> None:
    same = with_before(record, explained(after, after, held_out(bench)[1]), Path("old.npz"))
    assert same.held_out is not None
    assert (same.held_out.gain_sigmas, same.held_out.better) == (0, False)


def test_another_camera_and_a_bench_without_spare_images_are_refused(
    bench: Bench, after: Calibration
) -> None:
    with pytest.raises(
        ConfigError, match=r"--before old\.npz: got \(30, 40\) panel pixels.*expected \(31, 40\)"
    ):
        check_same_camera(after, replace(bench, panel_shape=(31, 40)), "old.npz")
    with pytest.raises(ConfigError, match=r"--before old\.npz: got slots of"):
        check_same_camera(after, replace(bench, slot_s=0.01), "old.npz")
    bare = replace(
        bench,
        flats=tuple(replace(group, dn=group.dn[:2]) for group in bench.flats),
        off=replace(bench.off, dn=bench.off.dn[:1]),
        greys=(),
        glare=(),
        dots=tuple(replace(group, dn=group.dn[:1]) for group in bench.dots[:1]),
    )
    with pytest.raises(BenchError, match=r"0 settings with an image to spare.*no --before"):
        held_out(bare)
