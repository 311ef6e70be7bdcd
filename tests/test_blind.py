"""Blind registration, and the operators side by side: what had moved comes back, what hadn't stays."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_study import done_here, load, write_experiment

from optsim.calibration import Calibration, blind
from optsim.calibration.blind import NOT_MOVED, Registration, moved_back, registered_blind
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Frames, capture
from optsim.study.comparison import Seeds
from optsim.study.folder import Workplace
from optsim.study.operators import OperatorsPlan, operators, rows_of
from optsim.study.operators_page import found_lines, lead, lines_of, write_operators_page
from optsim.study.stage import Stage, stage_of

DRIFT = {"shift_x_px": 0.6, "shift_y_px": -0.9, "rotation_rad": 2e-3}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    return load(write_experiment(tmp_path_factory.mktemp("film")), "hdr_mosaic", "normal")


@pytest.fixture(scope="module")
def drifted(base: Experiment) -> Experiment:
    return base.model_copy(update={"drift": {"relay": DRIFT}})


@pytest.fixture(scope="module")
def stage(drifted: Experiment) -> Stage:
    """The study's own; its calibrations are of the camera before the drift."""
    return stage_of(drifted.model_dump_json(), 1)


@pytest.fixture(scope="module")
def known(base: Experiment, stage: Stage) -> Calibration:
    return stage.calibrations[base.calibration_choice]


@pytest.fixture(scope="module")
def frames(base: Experiment, stage: Stage) -> Frames:
    """Of the camera that has not moved."""
    return capture(base, base.camera.with_nd(stage.light.nd_transmission), stage.truth, stage.calibrations)


@pytest.fixture(scope="module")
def record(drifted: Experiment, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("study")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("optsim.study.folder.run_tasks", done_here)
        found = operators(drifted, OperatorsPlan(1, Seeds(1, 1)), Workplace(folder))
    write_operators_page(folder, found)
    return {**found, "folder": folder}


def test_a_shift_and_a_rotation_come_back_from_the_frames_alone(record: dict[str, Any]) -> None:
    (found,) = (row for row in record["registrations"] if row["method"] == "hdr_mosaic")
    assert not found["why"]
    # A thirtieth of a panel pixel; it was a fifteenth, by 0.15 towards x.
    assert found["shift_x_px"] == pytest.approx(0.6, abs=0.1)
    assert found["shift_y_px"] == pytest.approx(-0.9, abs=0.1)
    assert found["after"] < 0.5 * found["before"]
    assert (found["true_shift_x_px"], found["true_rotation_rad"]) == (0.6, 2e-3)


@pytest.mark.parametrize("rotation_rad", [4e-3, pytest.param(-4e-3, marks=pytest.mark.slow)])
def test_a_rotation_comes_back_with_its_sign(
    base: Experiment, stage: Stage, known: Calibration, rotation_rad: float
) -> None:
    turned = base.model_copy(update={"drift": {"relay": {"rotation_rad": rotation_rad}}})
    camera = turned.at_work().with_nd(stage.light.nd_transmission)
    taken = capture(turned, camera, stage.truth, stage.calibrations)["hdr_mosaic"]
    found = registered_blind(taken, known).registration
    # A third too much before crosstalk by reading between pixels was known. A bar crosses half of the panel.
    assert found.rotation_rad == pytest.approx(rotation_rad, rel=0.2)
    assert abs(found.shift_x_px) + abs(found.shift_y_px) < 0.1


def rolled(frames: Sequence[CodedFrame], down: int, right: int) -> tuple[CodedFrame, ...]:
    """Frames of an image that lies whole CCD pixels beside where it was; black comes in."""

    def moved(dn: np.ndarray) -> np.ndarray:
        black, (rows, cols) = np.full_like(dn, int(np.median(dn[:2]))), dn.shape
        black[max(down, 0) : rows + down, max(right, 0) : cols + right] = dn[
            max(-down, 0) : rows - down, max(-right, 0) : cols - right
        ]
        return black

    return tuple(replace(frame, dn=moved(frame.dn)) for frame in frames)


@pytest.mark.slow
def test_a_shift_of_more_than_a_panel_pixel_comes_back(frames: Frames, known: Calibration) -> None:
    found = registered_blind(rolled(frames["hdr_mosaic"], 4, -5), known)
    assert not found.why
    assert found.registration.shift_y_px == pytest.approx(4, abs=0.1)
    assert found.registration.shift_x_px == pytest.approx(-5, abs=0.1)


@pytest.mark.slow
def test_a_repeat_of_the_code_beside_the_panel_is_passed_over(
    frames: Frames, known: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A whole period of the mosaic away the frames agree as well, but a side of the panel is dark."""
    moved = rolled(frames["hdr_mosaic"], 2, -1)
    real = blind._agreement

    def repeated(some, samples, calibration, at):  # the repeat agrees better than the truth
        found = real(some, samples, calibration, at)
        away = math.hypot(at.shift_y_px + 4, at.shift_x_px + 5) < 0.8
        return replace(found, losses=0 * found.losses) if away and len(some) <= 3 else found

    monkeypatch.setattr(blind, "_agreement", repeated)
    found = registered_blind(moved, known)
    assert not found.why
    assert found.registration.shift_y_px == pytest.approx(2, abs=0.1)
    assert found.registration.shift_x_px == pytest.approx(-1, abs=0.1)


@pytest.mark.slow
def test_what_is_beyond_the_search_is_not_found_rather_than_wrong(frames: Frames, known: Calibration) -> None:
    far = registered_blind(rolled(frames["hdr_mosaic"], 13, 11), known)
    assert far.registration == NOT_MOVED
    assert "not found" in far.why


def test_blind_wins_back_most_and_the_true_operator_is_best(record: dict[str, Any]) -> None:
    db = {(row["method"], row["what"]): row["db"] for row in record["rows"] if row["region"] == "static"}
    ideal, calibrated, blind, true = (
        db["hdr_mosaic", each] for each in ("ideal", "calibrated", "blind", "true")
    )
    assert ideal < calibrated < blind < true
    assert blind - calibrated > 0.5 * (true - calibrated) > 1
    assert db["hdr_mosaic", "blind recovery"] == pytest.approx(blind - calibrated)
    assert db["hdr_mosaic", "knowledge limit"] == pytest.approx(true - ideal)


def test_what_tells_nothing_stays_as_it_is(record: dict[str, Any]) -> None:
    (found,) = (row for row in record["registrations"] if row["method"] == "normal")
    assert "same exposures" in found["why"]
    assert found["shift_x_px"] == 0
    db = {row["what"]: row["db"] for row in record["rows"] if row["method"] == "normal"}
    assert db["blind recovery"] == 0


def test_a_camera_that_has_not_moved_is_left_alone(frames: Frames, known: Calibration) -> None:
    found = registered_blind(frames["hdr_mosaic"], known)
    assert found.registration == NOT_MOVED
    assert "no movement" in found.why
    assert moved_back(frames["hdr_mosaic"], known, NOT_MOVED) == frames["hdr_mosaic"]
    few = registered_blind(frames["hdr_mosaic"][:3], known)
    assert (few.registration, few.why) == (NOT_MOVED, "got 3 frames, expected at least 4")


def test_frames_move_back_by_what_is_said_and_saturation_spreads(known: Calibration) -> None:
    rows, cols = known.ccd_shape
    y, x = np.indices((rows, cols), np.float64)
    moved = Registration(0.7, -1.2, 3e-3)

    def scene(down: np.ndarray, right: np.ndarray) -> np.ndarray:
        return 2000 + 800 * np.sin(down / 9) + 600 * np.cos(right / 7)

    # The light that was at (y, x) is now at moved.now(y, x): the inverse, by fixed-point iteration.
    down, right = y, x
    for _ in range(20):
        now_y, now_x = moved.now(down, right, (rows, cols))
        down, right = down + y - now_y, right + x - now_x
    code = ExposureCode(np.zeros((1, 1, 1), np.uint8), np.zeros((1, 1), np.bool_))
    frame = CodedFrame(0, np.rint(scene(down, right)).astype(np.uint16), code)
    (back,) = moved_back([frame], known, moved)
    inside = known.valid & (known.centre_row > 3) & (known.centre_row < rows - 4)
    inside &= (known.centre_col > 3) & (known.centre_col < cols - 4)
    at = known.centre_row[inside], known.centre_col[inside]
    np.testing.assert_allclose(back.dn[at], scene(y, x)[at], atol=2)
    dn = frame.dn.copy()
    dn[known.centre_row[9, 12], known.centre_col[9, 12]] = 16383
    (back,) = moved_back([replace(frame, dn=dn)], known, Registration(0.5, 0.5))
    full = np.argwhere(back.dn >= known.saturation_dn.min())
    assert full.tolist() == [[known.centre_row[9, 12], known.centre_col[9, 12]]]


def test_the_page_and_the_terminal_say_it(record: dict[str, Any]) -> None:
    folder: Path = record["folder"]
    page = (folder / "study.html").read_text()
    for said in ("calibration loss (true − calibrated)", "What the frames told themselves", "moved back"):
        assert said in page
    assert len(list((folder / "pictures").glob("*.png"))) == 1 + 2 * 4
    assert lead(record).startswith("normal, everywhere: calibration loss")
    assert len(lines_of(record["rows"], "hdr_mosaic")) == 4 + 3
    assert {line[0] for line in found_lines(record)} == {"hdr_mosaic", "normal"}


def test_differences_are_of_pairs_and_say_when_seeds_cannot_tell_them() -> None:
    def seed(level: float, blind: float) -> list[list[Any]]:
        db = {"ideal": 20.0, "calibrated": 25.0, "blind": 25.0 + blind, "true": 28.0}
        return [[name, "m", "all", value + level] for name, value in db.items()]

    rows = {row["what"]: row for row in rows_of([seed(0, 1.0), seed(5, -1.1), seed(-3, 0.4), seed(1, -0.2)])}
    assert rows["calibration loss"]["db"] == pytest.approx(3)
    assert rows["calibration loss"]["db_half"] == pytest.approx(0, abs=1e-9)
    assert not rows["calibration loss"]["below_noise"]
    assert rows["blind recovery"]["below_noise"]
    assert rows["true"]["db_half"] > 5
