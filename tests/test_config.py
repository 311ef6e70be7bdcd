"""Quantity strings, unknown keys, overrides: what a user sees when an experiment is wrong."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from optsim.camera.hardware import icx674, imx174, sources
from optsim.core.config import Part, build, override, read_toml
from optsim.core.errors import ConfigError
from optsim.core.units import parse_quantity, units_of
from optsim.experiment.experiment import load_experiment
from optsim.experiment.schema import experiment_schema, explain_key


class Lens(Part):
    kind: Literal["lens"] = "lens"
    focal_length_m: float = 12.5e-3
    tilt_rad: float = 0.0
    count: int = 1


class Camera(Part):
    lens: Lens = Lens()


@pytest.mark.parametrize(
    ("key", "text", "value"),
    [
        ("focal_length_m", "12.5 mm", 0.0125),
        ("pitch_m", "20um", 20e-6),
        ("slot_s", "5.5 ms", 5.5e-3),
        ("rate_hz", "180 Hz", 180.0),
        ("tilt_rad", "0.5 deg", 0.008726646259971648),
        ("full_well_e", "15.77 ke-", 15770.0),
    ],
)
def test_quantities_become_si(key: str, text: str, value: float) -> None:
    assert parse_quantity(key, text) == pytest.approx(value, rel=1e-12)


@given(st.floats(min_value=-1e12, max_value=1e12, allow_nan=False))
def test_any_number_of_millimetres(number: float) -> None:
    assert parse_quantity("x_m", f"{number!r} mm") == number * 1e-3


@pytest.mark.parametrize("text", ["12.5 s", "mm", "12,5 mm", "", "1 2 mm", "e mm"])
def test_wrong_quantities_name_key_and_cure(text: str) -> None:
    with pytest.raises(ValueError, match=r"write for example focal_length_m"):
        parse_quantity("focal_length_m", text)
    with pytest.raises(ConfigError, match=rf"lens\.focal_length_m: got {text!r}, .*write for example"):
        build(Camera, {"lens": {"focal_length_m": text}}, where="x")


def test_unknown_key_names_the_nearest() -> None:
    with pytest.raises(
        ConfigError, match=r"lens\.focal_lenght_m: unknown key; did you mean 'focal_length_m'"
    ):
        build(Camera, {"lens": {"focal_lenght_m": 0.01}}, where="test.toml")


def test_all_problems_are_listed_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        build(Camera, {"lens": {"focal_length_m": "1 s", "count": "many"}, "lnes": 3}, where="test.toml")
    message = str(caught.value)
    assert "lens.focal_length_m: got '1 s', the unit 's' is of another dimension" in message
    assert "lens.count: got 'many', expected a whole number" in message
    assert "lnes: unknown key" in message


def test_infinite_numbers_are_refused() -> None:
    with pytest.raises(ConfigError, match="focal_length_m"):
        build(Lens, {"focal_length_m": float("inf")}, where="x")


def test_override_sets_nested_keys_without_touching_the_source() -> None:
    table = {"lens": {"count": 1}, "methods": [{"name": "a"}]}
    changed = override(table, ["lens.count=3", "lens.focal_length_m='25 mm'", "methods.0.name=b"])
    assert changed == {"lens": {"count": 3, "focal_length_m": "25 mm"}, "methods": [{"name": "b"}]}
    assert table == {"lens": {"count": 1}, "methods": [{"name": "a"}]}


@pytest.mark.parametrize("bad", ["lens.count", "=3", "lens.count.deep=3", "lens.count.deep.er=3"])
def test_bad_overrides(bad: str) -> None:
    with pytest.raises(ConfigError, match="--set"):
        override({"lens": {"count": 1}}, [bad])


def test_more_of_a_part_that_is_a_name_is_refused_with_the_cure() -> None:
    with pytest.raises(
        ConfigError, match=r"name 'imx174'; for more of it, set camera\.sensor\.hardware=imx174"
    ):
        override({}, ["camera.sensor=imx174", "camera.sensor.rows=400"])


def test_a_table_in_a_list_is_set_by_its_name_or_place() -> None:
    table = {"methods": [{"name": "a", "x": 1}, {"name": "b", "x": 1}]}
    changed = override(table, ["methods.b.x=2", "methods.0.x=3"])
    assert [row["x"] for row in changed["methods"]] == [3, 2]
    for wrong in ("c", "2"):
        with pytest.raises(ConfigError, match=f"got '{wrong}', expected a, b, or a place from 0 to 1"):
            override(table, [f"methods.{wrong}.x=2"])


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        (
            "camera.objective.f_number=-1",
            "camera.objective.f_number: got -1, expected at least 0.7 and at most 64",
        ),
        ("seed=-1", "seed: got -1, expected at least 0 and less than 4294967296"),
        ("camera.wavelength_m=550", "(in m; a text such as '1 mm' works too)"),
        ("camera.relay.magnification=big", "expected a plain number (this key has no unit)"),
        ("camera.objective.focal_length_m='3 parsec'", "the unit 'parsec' is unknown"),
        ("n_frames=true", "n_frames: got 'true', expected a whole number"),
        ("camera.wavelength_m=true", "camera.wavelength_m: got 'true', expected a number with a unit"),
        ("camera.objective.focus_m=true", "or one of the words target, everywhere"),
        ("camera.objective.focal_length_m='4 Mm'", "the unit 'Mm' is unknown"),
        ("latency_frames=1", "latency_frames: unknown key; did you mean 'camera.latency_frames' or 'n_fra"),
        ("camera.hardwar=demo", "camera.hardwar: unknown key; did you mean 'hardware'?"),
        ("camera.effect.fringing=ideal", "camera.effect: unknown key; did you mean 'effects'?"),
        ("camera.sensor.hardwar=icx674", "camera.sensor.hardwar: unknown key; did you mean 'hardware'?"),
        ("camera=demo", "camera: got 'demo', expected a table; set camera.hardware to it"),
        (
            "camera.modulator.frame_rate_hz=3",
            "did you mean 'source.footage.frame_rate_hz' or 'field_rate_hz'",
        ),
        (
            "camera.objective.focus_m=[1]",
            "focus_m: got [1], expected a number, or one of: target, everywhere",
        ),
        ("camera.objective.focus_m=inf", "focus_m: got inf, expected a finite number, or one of: target,"),
        ("camera.objective.focus_m=evrywhere", "got 'evrywhere', did you mean 'everywhere'?"),
        ("n_frames=1.5", "n_frames: got 1.5, expected a whole number"),
        ("camera.overlap=3", "camera.overlap: got 3, expected true or false"),
        ("calibration=tru", "did you mean 'true'?"),
        ("camera.relay.shift_x=1", "shift_x: unknown key; did you mean 'shift_x_px'?"),
        ("camera.relay.ratio=3", "ratio: unknown key; keys here are: "),
        (
            "camera.drive_exponant=1",
            "drive_exponant: unknown key; did you mean 'camera.modulator.drive_exponent'?",
        ),
        (
            "methods.random.calibration=iedal",
            "methods.random.calibration: got 'iedal', expected one of: bench, true, ideal; did you mean",
        ),
        ("scene=3", "scene: got 3, expected a table with some of: name, variation, band"),
        ("scene.band=red", "'window_room' has no bands; leave scene.band out"),
        ("methods=3", "methods: got 3, expected a list"),
        ("foo=1", "foo: unknown key; keys here are: name, description, seed,"),
        ("camera.modulator.kind=x", "camera.modulator.kind: unknown key; keys here are: pitch_m,"),
        ("camera.modulator.field_drive=[1, 1]", "camera.modulator.field_drive.2: missing"),
        (
            "methods.0.scheme.kind=randm",
            "methods.adaptive.scheme.kind: got 'randm', expected one of: normal_photography,",
        ),
        (
            "methods.0.scheme=3",
            "methods.adaptive.scheme: got 3, expected a table whose kind is one of: normal_photography,",
        ),
        (
            "methods.normal.scheme.open_slot=3",
            "methods.normal.scheme.open_slot: unknown key; did you mean 'open_slots'?",
        ),
        (
            "methods.normal.scheme.growth=1",
            "methods.normal.scheme.growth: unknown key; keys here are: kind, open_slots",
        ),
        (
            "methods.normal.scheme.open_slots=0",
            "methods.normal.scheme.open_slots: got 0, expected at least 1",
        ),
        (
            "camera.effects.all=idael",
            "camera.effects.all 'idael'; expected one of: ideal, nominal, pessimistic; did",
        ),
        (
            "camera.effects.smear=off",
            "smear 'off'; expected one of: ideal, nominal, pessimistic; did you mean 'ideal'?",
        ),
        ("camera.effects.smear=None", "did you mean 'ideal'? ideal switches an effect off"),
        (
            "camera.effects.all=true",
            "camera.effects.all 'true'; expected one of: ideal, nominal, pessimistic; did you mean 'nom",
        ),
    ],
)
def test_a_wrong_value_says_where_what_and_the_cure(assignment: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_experiment("demo", [assignment])
    assert message in str(caught.value)
    # The file is right: what was set on the command line isn't.
    assert "demo.toml: " not in str(caught.value)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"hardwar": "demo"}, "camera.hardwar: unknown key; did you mean 'hardware'?"),
        ({"panel_rows": "3"}, "camera: got panel_rows, expected hardware = one of prototype, demo, or all"),
        ({}, "camera: got nothing, expected hardware = one of"),
    ],
)
def test_a_camera_that_is_none_is_told_of_hardware(
    camera: dict[str, str], message: str, tmp_path: Path
) -> None:
    keys = "\n".join(f"{key} = '{value}'" for key, value in camera.items())
    (tmp_path / "a.toml").write_text(f"name = 'a'\nmethods = []\n[camera]\n{keys}\n")
    with pytest.raises(ConfigError) as caught:
        load_experiment(str(tmp_path / "a.toml"))
    assert message in str(caught.value)


def test_two_methods_of_a_name_have_problems_of_their_own() -> None:
    with pytest.raises(ConfigError, match="4 problems"):
        load_experiment("demo", ["methods=[{name='a'}, {name='a'}]"])


def test_a_speed_is_no_time():
    assert parse_quantity("speed_m_s", "36 km/h") == pytest.approx(10)
    assert parse_quantity("pan_rad_s", "180 deg/s") == pytest.approx(np.pi)
    for key in ("speed_m_s", "pan_rad_s"):
        with pytest.raises(ValueError, match="the unit 'ms' is of another dimension than this key"):
            parse_quantity(key, "5 ms")


def test_both_letters_for_micro_are_read() -> None:
    assert parse_quantity("x_m", "3 \u00b5m") == parse_quantity("x_m", "3 \u03bcm") == pytest.approx(3e-6)


def test_a_misspelt_camera_or_kind_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("name = 'a'\nmethods = []\n[camra]\nhardware = 'demo'\n")
    with pytest.raises(ConfigError, match="did you mean 'camera' by 'camra'"):
        load_experiment(str(tmp_path / "a.toml"))
    with pytest.raises(
        ConfigError, match=r"scheme\.kind: got nothing \(did you mean it by 'knd'\?\), expected"
    ):
        load_experiment("demo", ["methods.0.scheme={knd = 'hdr_mosaic'}"])


def test_toml_that_is_none_is_quoted_and_a_missing_file_is_missing(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("name = 'a'\nn_frames = 07\n")
    with pytest.raises(ConfigError, match=r"line 2.*: 'n_frames = 07'"):
        load_experiment(str(tmp_path / "a.toml"))
    (tmp_path / "a.toml").write_bytes(b"\x93NUMPY")
    with pytest.raises(ConfigError, match="is no text, expected TOML"):
        load_experiment(str(tmp_path / "a.toml"))
    with pytest.raises(ConfigError, match=r"no such file.*means a preset"):
        load_experiment(str(tmp_path / "b.toml"))


class Shelf(Part):
    lenses: tuple[Lens, ...] = Field(min_length=1)


def test_a_list_with_a_wrong_item_is_not_called_too_short() -> None:
    with pytest.raises(ConfigError) as caught:
        build(Shelf, {"lenses": [{"count": "many"}]}, where="x")
    assert "lenses.0.count" in str(caught.value)
    assert "a list of" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"lenses: got \[\], expected a list of 1 or more"):
        build(Shelf, {"lenses": []}, where="x")


def test_a_file_is_read_anew_once_it_changed_and_each_reader_has_a_table_of_its_own(tmp_path) -> None:
    path = tmp_path / "table.toml"
    path.write_text("[lens]\nnodes = [1, 2]\n")
    first = read_toml(path)
    first["lens"]["nodes"].append(3)
    assert read_toml(path) == {"lens": {"nodes": [1, 2]}}
    path.write_text("[lens]\nnodes = [4, 5]\n")
    assert read_toml(path) == {"lens": {"nodes": [4, 5]}}


def test_the_schema_says_what_every_key_means():
    """Meaning, unit, and of the camera's numbers the sign, a typical value and its source."""
    schema = experiment_schema()
    texts = {
        (name, key): about
        for name, table in {**schema["$defs"], "Experiment": schema}.items()
        for key, about in table["properties"].items()
    }
    assert len(texts) > 220
    for (name, key), about in texts.items():
        text = about["description"]
        assert len(text) > 30, (name, key, text)
        assert units_of(key) == {} or f"Unit: {next(iter(units_of(key)))} " in f"{text} ", (name, key)
    parts = ("CodedCamera", "Objective", "Wavefront", "Splitter", "Modulator", "Relay", "Ccd")
    for (name, key), about in texts.items():
        text = about["description"]
        if name not in parts or "$ref" in about:
            continue
        assert "ource" in text, (name, key)
        number = about.get("type") in ("number", "integer")
        assert "Typical: " in text or not number, (name, key)
        # What may be negative says what that means.
        least = about.get("minimum", about.get("exclusiveMinimum", -1.0))
        assert least >= 0 or not number or "negative" in text or "positive" in text, (name, key)


def test_one_key_or_table_is_explained():
    (line,) = explain_key("camera.relay.shift_x_px")
    assert line.startswith("camera.relay.shift_x_px: Shift of the panel's image")
    assert line.endswith(
        "Unit: pixels. Typical: 0 (prototype). No source: a default of this project. Default: 0.0."
    )
    (line,) = explain_key("camera.sensor.read_noise_e")
    assert "Typical: 9.39 (prototype). Source: Point Grey camera table (AudeLA)." in line
    assert line.endswith("No default.")
    told = explain_key("camera.relay")
    assert told[0].startswith("camera.relay: ")
    assert sum(each.startswith("    shift_x_px: Shift") for each in told) == 1
    told = explain_key("methods.0.decoder")
    at = next(i for i, each in enumerate(told) if each.startswith("  kind = hdr_merge: Merge"))
    assert told[at + 1].startswith("    n_frames: Frames looked back")
    assert explain_key("drift.modulator.delay_s")[0].startswith("drift.modulator.delay_s: ")
    # Every key of every table that can be reached has its line.
    assert all(explain_key(key) for key in experiment_schema()["properties"])


@pytest.mark.parametrize(
    ("key", "said"),
    [
        ("camera.relay.shift_xpx", "did you mean 'camera.relay.shift_x_px'"),
        ("cammera.relay", "unknown key 'cammera'.*did you mean 'camera'"),
        ("", "unknown key ''"),
        ("camera.", "unknown key 'camera.'"),
        ("seed.x", "got 'x', but seed is no table of known keys; cure: optsim config schema seed"),
    ],
)
def test_an_unknown_key_is_named_with_the_nearest(key, said):
    with pytest.raises(ConfigError, match=said):
        explain_key(key)


def test_a_number_of_the_schema_is_the_data_sheets_with_the_comment_beside_it():
    read_noise = experiment_schema()["$defs"]["Ccd"]["properties"]["read_noise_e"]["description"]
    assert "Typical: 9.39 (prototype). Source: Point Grey camera table (AudeLA)." in read_noise
    # A comment holds for the keys that follow; another sensor's doesn't count.
    assert sources(icx674)["Ccd", "dark_current_e_s"] == "Point Grey camera table (AudeLA)."
    assert sources(imx174)["Ccd", "cols"].startswith("Data of the same pixel in matrix-vision's")
    assert experiment_schema()["$defs"]["Relay"]["properties"]["keystone_y"]["description"].endswith(
        "Typical: 0 (prototype). No source: a default of this project."
    )


def test_rates_and_dioptres_are_no_times_and_lengths():
    assert parse_quantity("dark_current_e_s", "2 e-/s") == 2
    assert parse_quantity("defocus_per_m", "0.1 dpt") == 0.1
    for key, text in (("dark_current_e_s", "2 ms"), ("defocus_per_m", "3 mm")):
        with pytest.raises(ValueError, match="of another dimension"):
            parse_quantity(key, text)


def test_keys_by_name_override_and_are_checked() -> None:
    found = load_experiment("demo", ["n_frames=9"], n_frames=4, camera={"latency_frames": 2})
    assert (found.n_frames, found.camera.latency_frames) == (4, 2)
    assert found.camera.panel_rows == load_experiment("demo").camera.panel_rows
    with pytest.raises(ConfigError, match=r"demo\.toml with n_frame=4.*\n.*did you mean 'n_frames'"):
        load_experiment("demo", n_frame=4)


def test_an_experiment_says_what_it_is_in_a_line() -> None:
    assert repr(load_experiment("demo")) == (
        "<Experiment 'demo': window_room, 160 x 120 panel pixels, 10 coded frames by adaptive, normal, "
        "hdr_mosaic, random>"
    )
