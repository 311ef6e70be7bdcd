"""Do shift, rotation, magnification and keystone come back with their sign and interval?

Cameras are those of ``synthetic_bench``. A projective map, fitted to the dots by plain numpy, is the judge.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_bench import Camera
from test_cli import cli  # noqa: F401  a fixture

from optsim.calibration import Bench, read_calibration
from optsim.calibration.estimate import BenchResult, measure_calibration
from optsim.experiment.calibration_record import calibration_record
from optsim.report.calibration_page import CalibrationRecord

PANEL, CCD, RATIO = (40, 52), (140, 176), 2.88
KEYS = ("shift_y_px", "shift_x_px", "rotation_rad", "magnification_error", "keystone_y", "keystone_x")
PLANTED = {
    "one way": (2.3, -1.7, 0.008, 0.003, 0.004, -0.003),
    "the other": (-1.1, 2.2, -0.008, -0.004, -0.003, 0.005),
    "mirrored": (1.4, 0.9, 0.006, 0.002, 0.003, 0.004),
}


def camera_of(planted: tuple[float, ...], mirrored: bool = False) -> Camera:
    """A camera whose keystone is along its panel's rows and columns, whatever its rotation."""
    down, right, rotation, larger, *keystone = planted
    turn = -rotation if mirrored else rotation  # this camera is turned before it is mirrored

    def taper(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = -x if mirrored else x
        rows, cols = np.cos(turn) * y - np.sin(turn) * x, np.sin(turn) * y + np.cos(turn) * x
        half = np.array(PANEL) / 2 * RATIO * (1 + larger)
        scale = 1 / (1 + keystone[0] * rows / half[0] + keystone[1] * cols / half[1]) - 1
        return y * scale, (-x if mirrored else x) * scale

    return Camera(
        panel=PANEL, ccd=CCD, ratio=RATIO, shift=(down, right), rotation=turn, magnification=1 + larger,
        distortion=taper, mirrored=mirrored,
    )  # fmt: skip


Found = tuple[Bench, BenchResult, CalibrationRecord]


@pytest.fixture(scope="module", params=PLANTED)
def found(request: pytest.FixtureRequest) -> tuple[tuple[float, ...], Found]:
    planted = PLANTED[request.param]
    return planted, measured_of(camera_of(planted, request.param == "mirrored"))


def measured_of(camera: Camera) -> Found:
    bench = camera.bench()
    measured = measure_calibration(bench)
    return bench, measured, calibration_record(measured, bench, Path("bench"))


def test_misalignments_come_back_within_their_intervals(found: tuple[tuple[float, ...], Found]) -> None:
    planted, (_, measured, record) = found
    values, errors = measured.calibration.misalignment, measured.calibration.standard_errors
    off = {key: (values[key] - true) / errors[key] for key, true in zip(KEYS, planted, strict=True)}
    # Of six intervals of 95 % one may fail; none is three standard errors off.
    assert sum(abs(each) > 1.96 for each in off.values()) <= 1, off
    assert max(abs(each) for each in off.values()) < 3, off
    for key, true in zip(KEYS, planted, strict=True):
        assert record.quantity(key).interval == pytest.approx(1.96 * errors[key])
        assert record.quantity(key).interval < 0.25 * abs(true)  # tight enough to mean something
    assert abs(values["distortion"]) < 3 * errors["distortion"]


def test_a_projective_map_by_numpy_alone_says_the_same(found: tuple[tuple[float, ...], Found]) -> None:
    planted, (_, measured, _) = found
    pixel_map = measured.pixel_map
    panel = pixel_map.dots_px - np.array(PANEL) / 2
    y, x = (pixel_map.on_ccd(pixel_map.dots_px) + pixel_map.off_ccd_px - np.array(CCD) / 2).T
    if planted == PLANTED["mirrored"]:
        x = -x
    ones, none = np.ones(len(panel)), np.zeros((len(panel), 3))
    point = np.column_stack([panel, ones])
    rows = np.concatenate(
        [
            np.column_stack([point, none, -y[:, None] * panel]),
            np.column_stack([none, point, -x[:, None] * panel]),
        ]
    )
    h = np.linalg.lstsq(rows, np.concatenate([y, x]))[0]
    shift, slant = h[[2, 5]], h[6:]
    turned = np.array([h[0:2], h[3:5]]) - np.outer(shift, slant)
    rotation = np.arctan2(turned[0, 1] - turned[1, 0], turned[0, 0] + turned[1, 1])
    larger = np.sqrt(np.linalg.det(turned)) / RATIO - 1
    mine = [*shift, rotation, larger, *(slant * np.array(PANEL) / 2)]
    if planted == PLANTED["mirrored"]:
        mine[1:3] = -mine[1], -mine[2]
    values, errors = measured.calibration.misalignment, measured.calibration.standard_errors
    for key, ours in zip(KEYS, mine, strict=True):
        # The distortion that this one has not is correlated with the magnification.
        assert values[key] == pytest.approx(ours, abs=2 * errors[key]), key


def test_units_and_the_move_that_undoes_it(found: tuple[tuple[float, ...], Found]) -> None:
    planted, (bench, _, record) = found
    rows = {each.key: each for each in record.misaligned}
    corner_px = np.hypot(*PANEL) / 2
    for key, true in zip(KEYS, planted, strict=True):
        row, value = rows[key], record.quantity(key).value
        lever_px = 1 / (RATIO * (1 + planted[3])) if key.startswith("shift") else corner_px
        assert row.panel_px == pytest.approx(true * lever_px, rel=0.1)
        assert bench.ccd_pitch_m == 4e-6
        assert row.ccd_m == pytest.approx(row.panel_px * RATIO * (1 + planted[3]) * 4e-6, rel=1e-3)
        assert row.panel_half_px / row.panel_px == pytest.approx(record.quantity(key).interval / value)
        assert row.undo == -value
    down, right, rotation, larger, key_y, key_x = (each > 0 for each in planted)
    micrometres = f"{abs(record.quantity('shift_y_px').value) * 4:.4g} µm"
    assert f"{micrometres} towards its {'last' if down else 'first'} row" in rows["shift_y_px"].screw
    assert f"towards its {'last' if right else 'first'} column" in rows["shift_x_px"].screw
    assert f"mrad {'clockwise' if rotation else 'anticlockwise'}" in rows["rotation_rad"].screw
    assert rows["magnification_error"].screw.endswith("smaller" if larger else "larger")
    assert rows["keystone_y"].screw.endswith("larger" if key_y else "smaller")
    assert rows["keystone_x"].screw.endswith("larger" if key_x else "smaller")


def test_a_camera_moved_back_by_what_it_says_is_aligned() -> None:
    """Image and screw: the image by ``undo``, or the CCD by its opposite, which follows the image."""
    _, _, record = measured_of(camera_of(PLANTED["one way"]))
    undo = [next(each.undo for each in record.misaligned if each.key == key) for key in KEYS]
    left = tuple(true + by for true, by in zip(PLANTED["one way"], undo, strict=True))
    _, measured, again = measured_of(camera_of(left))
    for key in KEYS:
        assert abs(measured.calibration.misalignment[key]) < 5 * measured.calibration.standard_errors[key]
    assert sum(each.screw.startswith("none") for each in again.misaligned) >= 5


def test_it_is_on_the_page_the_console_in_json_and_in_the_file(
    tmp_path: Path, cli: Callable[..., tuple[int, str, str]]  # noqa: F811
) -> None:  # fmt: skip
    bench = camera_of(PLANTED["one way"]).bench()
    bench.write(tmp_path / "bench")
    code, out, err = cli("calibrate", str(tmp_path / "bench"), "--out", "mine.npz")
    assert code == 0, err
    record = CalibrationRecord.model_validate_json(Path("mine.json").read_text())
    back = read_calibration(Path("mine.npz"))
    page = Path("mine.html").read_text()
    for each in record.misaligned:
        quantity = record.quantity(each.key)
        assert back.misalignment[each.key] == quantity.value
        assert back.standard_errors[each.key] == quantity.standard_error
        assert f'data-value="{quantity.value}"' in page
        assert f'data-value="{each.panel_px}"' in page
        assert each.screw in page.replace("&#39;", "'")
        assert f"{each.key}: " in out
        assert each.screw.replace(" ", "") in re.sub(r"\s+", "", out)
    assert "Focus is not measured" in page
    about = json.loads(str(np.load("mine.npz")["about"]))
    assert about["misalignment"]["rotation_rad"] == back.misalignment["rotation_rad"]


def test_without_pitch_and_scale_the_rest_is_said() -> None:
    bench = replace(camera_of(PLANTED["one way"]).bench(), ccd_pitch_m=None, ccd_per_panel_px=None)
    record = calibration_record(measure_calibration(bench), bench, Path("bench"))
    rows = {each.key: each for each in record.misaligned}
    assert "magnification_error" not in rows
    assert rows["shift_y_px"].ccd_m is None
    assert "CCD pixels towards its last row" in rows["shift_y_px"].screw
    assert any("ccd_pitch_m" in each for each in record.remarks)
