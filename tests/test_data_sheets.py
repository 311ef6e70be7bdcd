"""Files that a laboratory has: a sensor's EMVA 1288 data sheet, and a measured grey curve of the panel."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_bench import Camera
from test_cli import cli  # noqa: F401  a fixture

from optsim.calibration import Bench, calibrate_from, read_calibration, read_grey_curve, write_calibration
from optsim.camera.hardware import demo, sensor_of
from optsim.camera.laboratory import bench_settings
from optsim.core.errors import BenchError, ConfigError
from optsim.experiment.experiment import load_experiment
from optsim.optics.panel import PanelResponse, settled_weight

CLI = Callable[..., tuple[int, str, str]]
SHEET = """
name = "made up"
rows = 1200
cols = 1920
pitch_m = "5.86 um"
quantum_efficiency = 0.7
saturation_capacity_e = 32000
dark_noise_e = 7.5
dark_current_e_s = 2.0
dsnu_e = 1.1
prnu = 0.006
gain_dn_e = 0.125
bits = 12
readout_s = "6.1 ms"
"""
LEVELS = (0.0, 40.0, 100.0, 180.0, 255.0)
REFLECTANCE = (0.01, 0.05, 0.3, 0.8, 1.01)


def as_xml(sheet: str) -> str:
    lines = [line.split(" = ") for line in sheet.strip().splitlines()]
    leaves = "".join(f"<{key}>{value.strip(chr(34))}</{key}>" for key, value in lines)
    return f'<sheet xmlns="urn:any"><sensor>{leaves}</sensor></sheet>'


@pytest.mark.parametrize("suffix", ["toml", "xml"])
def test_a_sensor_comes_from_its_data_sheet(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"sheet.{suffix}"
    path.write_text(SHEET if suffix == "toml" else as_xml(SHEET))
    found = sensor_of(path)
    assert (found.rows, found.cols, found.bits) == (1200, 1920, 12)
    # One over the system gain: electrons a number, not numbers an electron.
    assert found.gain_e == 8.0
    assert (found.full_well_e, found.read_noise_e, found.dark_current_e_s) == (32000, 7.5, 2.0)
    assert (found.dsnu_e, found.prnu, found.quantum_efficiency) == (1.1, 0.006, 0.7)
    assert found.pitch_m == pytest.approx(5.86e-6)
    assert found.readout_s == pytest.approx(6.1e-3)


def test_a_sheet_is_found_beside_the_experiment_and_keys_win_over_it(tmp_path: Path) -> None:
    (tmp_path / "sheet.toml").write_text(SHEET)
    name = "name = 'x'\n[scene]\nname = 'window_room'\n[[methods]]\nname = 'normal'\n"
    name += "scheme = { kind = 'normal_photography' }\ndecoder = { kind = 'hdr_merge' }\n"
    path = tmp_path / "mine.toml"
    path.write_text(name + "[camera]\nhardware = 'demo'\nsensor = { hardware = 'sheet.toml', prnu = 0.02 }\n")
    sensor = load_experiment(str(path)).camera.sensor
    assert (sensor.full_well_e, sensor.prnu) == (32000, 0.02)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("dark_noise_e = 7.5\n", ""), "dark_noise_e: got none, expected a number each; cure: add"),
        (("prnu = 0.006", "prnu = 0.6"), "prnu: got 0.6"),
        (("bits = 12", "bits = 'many'"), "bits: got 'many'"),
        (("bits = 12", "bits = 12\nquantum_eficiency = 1"), "quantum_eficiency: unknown key"),
    ],
)
def test_a_wrong_sheet_ends_in_one_line(cli: CLI, tmp_path: Path, change: tuple[str, str], said: str) -> None:  # noqa: F811
    for suffix, text in (("toml", SHEET.replace(*change)), ("xml", as_xml(SHEET.replace(*change)))):
        path = tmp_path / f"sheet.{suffix}"
        path.write_text(text.replace("'many'", "many") if suffix == "xml" else text)
        code, _, error = cli("explain", "demo", "--set", f"camera.sensor={path}")
        assert code == 2
        assert said in error
        assert "Traceback" not in error
        assert error.count("\n") <= 3


def test_other_files_are_no_sheets(tmp_path: Path) -> None:
    for name, text in (("a.xml", "<sheet><bits>1"), ("b.xml", "<!DOCTYPE a [<!ENTITY b 'c'>]><a/>")):
        (tmp_path / name).write_text(text)
        with pytest.raises(ConfigError, match=name):
            sensor_of(tmp_path / name)
    with pytest.raises(ConfigError, match="no such file"):
        sensor_of(tmp_path / "none.toml")


def curve_by_hand(level: float) -> float:
    """Transmission of a level: linear in the retardance between the pairs."""
    share = (np.array(REFLECTANCE) - REFLECTANCE[0]) / (REFLECTANCE[-1] - REFLECTANCE[0])
    retardance = np.interp(level, LEVELS, np.arccos(1 - 2 * share))
    return float((1 - np.cos(retardance)) / 2)


def test_the_panel_follows_the_measured_curve() -> None:
    pairs = tuple(zip(LEVELS, REFLECTANCE, strict=True))
    for white_rad in (np.pi, 2.6):
        response = PanelResponse(leak=0, grey_curve=pairs, white_rad=white_rad)
        seen = settled_weight(np.arange(256, dtype=np.uint8), response)
        at = (seen - seen[0])[[int(level) for level in LEVELS]]
        np.testing.assert_allclose(at, (np.array(REFLECTANCE) - 0.01) / 1.0, atol=1e-6)
    half_wave = settled_weight(np.array([20, 70, 220], np.uint8), PanelResponse(leak=0, grey_curve=pairs))
    np.testing.assert_allclose(half_wave, [curve_by_hand(level) for level in (20, 70, 220)], atol=1e-6)


def test_a_table_is_read_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "greys.csv"
    rows = list(zip(LEVELS, REFLECTANCE, strict=True))
    for header, order in (("level,reflectance\n", (0, 1)), ("Reflectance, Level\n", (1, 0)), ("", (0, 1))):
        path.write_text(header + "".join(f"{row[order[0]]},{row[order[1]]}\n" for row in rows))
        assert read_grey_curve(path) == tuple(rows)
    panel = load_experiment("demo", [f"camera.modulator.grey_curve={path}"]).camera
    assert panel.modulator.grey_curve == panel.panel_response.grey_curve == tuple(rows)
    assert bench_settings(panel)["grey_curve"] == tuple(rows)
    assert demo().modulator.grey_curve == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("grey,light\n0,0\n255,1\n", "got columns grey, light, expected level, reflectance"),
        ("0,0\n9,x\n255,1\n", "got the row '9,x', expected two numbers"),
        ("0,0\n255\n", "got the row '255'"),
        ("0,0\n100,0.5\n50,0.7\n255,1\n", "both rising"),
        ("0,0\n100,0.5\n254,1\n", "from level 0 to 254"),
        ("0,nan\n255,1\n", "got nan, expected a finite number"),
    ],
)
def test_a_wrong_table_ends_in_a_line(cli: CLI, tmp_path: Path, text: str, said: str) -> None:  # noqa: F811
    path = tmp_path / "greys.csv"
    path.write_text(text)
    code, _, error = cli("explain", "demo", "--set", f"camera.modulator.grey_curve={path}")
    assert code == 2
    assert said in " ".join(error.split())
    assert "Traceback" not in error


def test_a_bench_with_a_measured_curve_fits_no_exponent(tmp_path: Path) -> None:
    bench = Camera(panel=(30, 40), ccd=(108, 140), ratio=3.0, shift=(0, 0)).bench()
    bench.write(tmp_path / "bench")
    record = tmp_path / "bench" / "bench.json"
    pairs = tuple(zip(LEVELS, REFLECTANCE, strict=True))
    (tmp_path / "bench" / "greys.csv").write_text("\n".join(f"{a},{b}" for a, b in pairs))
    table = json.loads(record.read_text())
    record.write_text(json.dumps({**table, "grey_curve": "greys.csv"}))
    known = Bench.read(tmp_path / "bench")
    found = calibrate_from(known)
    assert found.response.grey_curve == pairs
    assert "drive_exponent" not in found.standard_errors
    write_calibration(tmp_path / "mine.npz", found)
    assert read_calibration(tmp_path / "mine.npz").response == found.response
    # It comes back from a folder of its own, too.
    replace(bench, grey_curve=pairs).write(tmp_path / "again")
    assert Bench.read(tmp_path / "again").grey_curve == pairs
    for wrong in ([[0, 0], [255, -1]], "none.csv", 3):
        record.write_text(json.dumps({**table, "grey_curve": wrong}))
        with pytest.raises(BenchError, match=r"bench\.json: grey_curve|none\.csv: got") as error:
            Bench.read(tmp_path / "bench")
        assert "\n" not in str(error.value)
