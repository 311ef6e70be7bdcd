"""A bench that is not what its manifest says is refused in one line, with the images and a cure.

Every change here is one that an operator makes: files exchanged, patterns counted from 1, a mirrored panel.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_bench import Camera
from test_cli import cli  # noqa: F401  a fixture

from optsim.calibration import Bench, calibrate_from
from optsim.calibration.bench_images import Group
from optsim.calibration.estimate import measure_calibration
from optsim.calibration.orientation import DIRECTIONS, UPRIGHT
from optsim.core.errors import BenchError
from optsim.core.files import write_png16
from optsim.experiment.calibration_record import calibration_record

PANEL, CCD = (40, 52), (140, 176)
Change = Callable[[Bench], dict[str, Any]]


@pytest.fixture(scope="module")
def bench() -> Bench:
    return replace(Camera(panel=PANEL, ccd=CCD).bench(), orientation=UPRIGHT)


def with_images(bench: Bench, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """All images of a bench, changed alike."""

    def changed(held: Group | tuple[Group, ...]) -> Any:
        if isinstance(held, tuple):
            return tuple(changed(each) for each in held)
        return replace(held, dn=np.ascontiguousarray(change(held.dn)))

    groups = {name: changed(getattr(bench, name)) for name in Bench.SETS}
    return {"darks": np.ascontiguousarray(change(bench.darks)), **groups}


def exchanged(name: str, first: int, second: int) -> Change:
    """Exchange the images of two settings, all frames of each."""

    def change(bench: Bench) -> dict[str, Any]:
        held = list(getattr(bench, name))
        one, two = held[first].dn, held[second].dn
        held[first], held[second] = replace(held[first], dn=two), replace(held[second], dn=one)
        return {name: tuple(held)}

    return change


def one_frame(name: str, index: int | None, taken: Callable[[Bench], np.ndarray]) -> Change:
    """Put a frame of another setting in the place of a setting's last."""

    def change(bench: Bench) -> dict[str, Any]:
        held = getattr(bench, name)
        if name == "darks":
            return {name: np.concatenate([held[:-1], taken(bench)[:1]])}
        group = held if index is None else held[index]
        group = replace(group, dn=np.concatenate([group.dn[:-1], taken(bench)[:1]]))
        return {name: group if index is None else (*held[:index], group, *held[index + 1 :])}

    return change


def shifted(names: tuple[str, ...], down: int, right: int) -> Change:
    """State the patterns of some sets to be elsewhere than they were shown."""

    def change(bench: Bench) -> dict[str, Any]:
        def moved(group: Any) -> Any:
            rows, cols = (
                tuple(p + by for p in places) for places, by in ((group.rows, down), (group.cols, right))
            )
            return replace(group, rows=rows, cols=cols)

        return {name: tuple(moved(group) for group in getattr(bench, name)) for name in names}

    return change


def moved(px: float, *of: str) -> Change:
    """Take some images with the CCD moved along its rows by a share of a panel pixel."""

    def change(bench: Bench) -> dict[str, Any]:
        there = replace(
            Camera(panel=PANEL, ccd=CCD, shift=(3.3, -2.7 + 2.88 * px)).bench(), about=bench.about
        )
        changed: dict[str, Any] = {}
        for each in of:
            name, _, index = each.partition("[")
            held, other = getattr(bench, name), getattr(there, name)
            if index:
                number, _, frame = index.partition("].")
                number = int(number.rstrip("]"))
                dn = held[number].dn.copy()
                dn[int(frame) if frame else slice(None)] = other[number].dn[
                    int(frame) if frame else slice(None)
                ]
                other = (*held[:number], replace(held[number], dn=dn), *held[number + 1 :])
            changed[name] = other
        return changed

    return change


PATTERNS = ("anchors", "dots", "glare")
REFUSED: dict[str, tuple[Change, str]] = {
    "counted from 1": (shifted(("anchors", "dots"), 1, 1), r"dots\[0\].*ends -?\+?.*count from 0"),
    "shifted by one column": (
        shifted(("anchors", "dots"), 0, 1),
        r"ends -[01]\.\d+ at the left, \+[01]\.\d+ at the right",
    ),
    "dots shifted against anchors": (shifted(("dots",), 0, -1), r"anchors\[0\].*columns of the panel from"),
    "lattices exchanged": (exchanged("dots", 0, 1), r"(dots|anchors)\[[01]\]: got"),
    "anchors exchanged": (exchanged("anchors", 0, 1), r"anchors\[\d\]"),
    "glare exchanged": (exchanged("glare", 0, 1), r"glare\[0\].*times the light of the dark rest"),
    "flats exchanged": (exchanged("flats", 0, 2), r"flats\[0\].*times the light of the other flats"),
    "greys exchanged": (exchanged("greys", 0, 1), r"greys\[1\].*exponent"),
    "steps exchanged": (exchanged("steps", 3, 20), r"steps\[(3|20)\].*full light"),
    "a lit dark": (one_frame("darks", None, lambda b: b.flats[0].dn), r"darks, frame 15: .*DN rms off"),
    "a flat of another light": (one_frame("flats", 1, lambda b: b.flats[2].dn), r"flats\[1\], frame 7"),
    "a dot pattern of another lattice": (one_frame("dots", 2, lambda b: b.dots[0].dn), r"dots\[2\], frame"),
    "one lattice moved": (
        moved(0.4, "dots[2]"),
        r"dots\[2\], frame \d: got dots [+-]0\.00\d rows and \+0\.[34]\d+ columns .*beside .* dots\[\d\], f",
    ),
    "one lattice moved a little": (moved(0.06, "dots[1]"), r"dots\[1\], frame .: got .*camera moved"),
    "one frame moved": (moved(0.2, "dots[3].1"), r"dots\[3\], frame 1: got dots .*camera moved"),
    "dots moved": (moved(0.4, "dots"), r"anchors\[0\].* -0\.4\d columns .*map of bench dots\[0\].*moved"),
    "an anchor moved": (moved(-0.2, "anchors[1]"), r"anchors\[1\].* -0\.\d+ columns"),
    "patterns moved": (
        moved(0.4, "dots", "anchors"),
        r"dots\[0\].* \+0\.\d+ at the left, -0\.\d+ at the right.*moved between dots and flats",
    ),
    "a saturated flat": (
        lambda b: {"flats": (*b.flats[:2], replace(b.flats[2], dn=b.saturated.dn))},
        r"flats\[2\]: got 100% of its pixels saturated",
    ),
    "off that is on": (lambda b: {"off": replace(b.off, dn=b.flats[0].dn)}, r"off: got .*glare\[0\]"),
    "off that is on, in its light": (lambda b: {"off": b.flats[2]}, "darker when off"),
    "mirrored": (lambda b: with_images(b, lambda dn: dn[:, :, ::-1]), "mirrored left.*expected upright"),
    "transposed": (lambda b: with_images(b, lambda dn: dn.swapaxes(1, 2)), "transposed.*expected upright"),
    "half outside": (lambda b: with_images(b, lambda dn: dn[:, :, :88]), r"anchors\[1\].*falls on the CCD"),
    "a fifth outside": (lambda b: with_images(b, lambda dn: dn[:, :, :140]), "pixels on the CCD, expected"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_it_is_refused_with_its_images_and_a_cure(bench: Bench, name: str) -> None:
    change, message = REFUSED[name]
    with pytest.raises(BenchError, match=message) as raised:
        calibrate_from(replace(bench, **change(bench)))
    assert "cure: " in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("mirror", [0, 1, 2])
def test_an_orientation_that_nobody_states_is_found(bench: Bench, mirror: int) -> None:
    """Calibrated as it is, and said."""
    turn = (lambda dn: dn[:, ::-1], lambda dn: dn[:, :, ::-1], lambda dn: dn.swapaxes(1, 2))[mirror]
    found = measure_calibration(replace(bench, **with_images(bench, turn), orientation=None))
    want = (("up", "right"), ("down", "left"), ("right", "down"))[mirror]
    assert found.pixel_map.orientation == want
    assert found.calibration.map_residual_px < 0.01
    upright = calibrate_from(bench)
    row, col = upright.centre_row, upright.centre_col
    there = ((CCD[0] - 1 - row, col), (row, CCD[1] - 1 - col), (col, row))[mirror]
    # A centre within noise of a border may fall on either side of it.
    for ours, theirs in zip((found.calibration.centre_row, found.calibration.centre_col), there, strict=True):
        assert np.mean(ours == theirs) > 0.98
        assert np.abs(ours - theirs).max() <= 1


def test_there_are_eight_orientations() -> None:
    assert len(set(DIRECTIONS)) == 8


def test_a_good_bench_shows_its_edges_where_the_map_has_them(bench: Bench) -> None:
    found = measure_calibration(bench).edges_off_px
    assert set(found) == {"top", "bottom", "left", "right"}
    assert max(abs(off) for off in found.values()) < 0.2


def test_a_panel_of_another_size_is_told_from_a_shift(bench: Bench) -> None:
    with pytest.raises(BenchError, match="panel_shape says 41 rows"):
        calibrate_from(replace(bench, panel_shape=(41, 52)))


def test_a_pattern_beyond_the_panel_is_refused(bench: Bench) -> None:
    with pytest.raises(BenchError, match=r"rows: got patches at .* expected 0 to 35"):
        replace(bench, panel_shape=(36, 52))


@pytest.fixture(scope="module")
def folder(bench: Bench, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench")
    bench.write(path)
    return path


def edited(folder: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A folder with the same images by absolute path and a changed manifest."""
    record = json.loads((folder / "bench.json").read_text())
    text = json.dumps(record)
    for image in folder.glob("*.png"):
        text = text.replace(f'"{image.name}"', json.dumps(str(image)))
    record = json.loads(text)
    change(record)
    (tmp_path / "bench.json").write_text(json.dumps(record))
    return tmp_path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r["dots"][1]["files"].append("dots-77.png"), r"dots-77\.png; .*under dots\[1\]\.files"),
        (lambda r: r.update(exposure_s=0.1), "exposure_s: got 0.1, expected coded_slots x slot_s, 0.2 s"),
        (lambda r: r.update(unit="electrons"), "unit: got 'electrons', expected 'DN'"),
        (lambda r: r.update(orientation=["down", "down"]), "orientation: got .*expected one of"),
        (lambda r: r.update(orientaton=["down", "left"]), "orientaton: got an unknown key.*'orientation'"),
        (lambda r: r["flats"][0].update(level=300), r"flats\[0\]\.level: got 300, expected a drive level"),
        (lambda r: r["off"].update(irradiance_w_m2=0), "irradiance_w_m2: got 0, expected a number above 0"),
        (lambda r: r.update(coded_slots=99, exposure_s=99 / 180), "coded_slots: got 99, expected 1 to slots"),
        (lambda r: r["flats"][1].update(gain=2), r"flats\[1\]\.gain: got an unknown key; cure: put it into"),
        (lambda r: r["off"].update(levle=0), r"off\.levle: got an unknown key; cure: did you mean 'level'"),
        (lambda r: r["dots"][2].update(colour="green"), r"dots\[2\]\.colour: got an unknown key"),
        (lambda r: r["steps"][3].update(delay_ms=3), r"steps\[3\]\.delay_ms: got .*mean 'delay_s'"),
        (lambda r: r.update(ccd_pitch_m=4.54), "ccd_pitch_m: got 4.54, expected metres, below 0.001"),
        (lambda r: r.update(ccd_per_panel_px="3"), "ccd_per_panel_px: got '3', expected a number"),
        (lambda r: r.update(steps="none"), "steps: got 'none', expected a list of objects"),
    ],
)  # fmt: skip
def test_a_manifest_that_is_wrong_is_refused_by_the_command(
    folder: Path, tmp_path: Path, cli: Callable[..., tuple[int, str, str]], change: Any, message: str  # noqa: F811
) -> None:  # fmt: skip
    code, out, err = cli("calibrate", str(edited(folder, tmp_path, change)))
    assert code == 2
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    with pytest.raises(BenchError, match=message):
        Bench.read(tmp_path)
    assert not Path("calibration.npz").exists()


def test_images_of_two_sizes_and_of_8_bits_are_named(folder: Path, tmp_path: Path) -> None:
    write_png16(tmp_path / "small.png", np.zeros((10, 12), np.uint16))
    path = edited(folder, tmp_path, lambda r: r["off"].update(files=["small.png"]))
    with pytest.raises(
        BenchError, match=r"small\.png \(off\): got images of \(10, 12\) pixels, expected \(140"
    ):
        Bench.read(path)
    from PIL import Image

    Image.fromarray(np.zeros(CCD, np.uint8)).save(tmp_path / "short.png")
    path = edited(folder, tmp_path, lambda r: r["off"].update(files=["short.png"]))
    with pytest.raises(BenchError, match=r"short\.png: got grey of 8 bits.*under off\.files"):
        Bench.read(path)


def test_a_file_is_named_where_its_images_are_wrong(folder: Path, tmp_path: Path) -> None:
    def exchange(record: dict[str, Any]) -> None:
        one, two = record["dots"][0], record["dots"][3]
        one["files"], two["files"] = two["files"], one["files"]

    with pytest.raises(BenchError, match=r"dots-0[03]-00\.png, \.\.\. \(dots\[[03]\]\)"):
        calibrate_from(Bench.read(edited(folder, tmp_path, exchange)))


def test_every_field_of_a_bench_is_in_its_manifest(folder: Path) -> None:
    record = json.loads((folder / "bench.json").read_text())
    assert {each.name for each in fields(Bench)} - {"files"} <= record.keys()


def remarks(bench: Bench) -> str:
    return " ".join(calibration_record(measure_calibration(bench), bench, Path("bench")).remarks)


def test_left_justified_data_are_said(bench: Bench) -> None:
    """Of 12 bits in words of 16, frames to decode that are not stored alike would be misread by 16 times."""
    assert "multiples" not in remarks(bench)
    left = replace(bench, **with_images(bench, lambda dn: (dn >> 2) << 4))
    assert "All DN are multiples of 16: left-justified by 4 bits" in remarks(left)


@pytest.mark.parametrize("slots", [0.15, -0.1])
def test_a_delay_common_to_all_flashes_is_said(bench: Bench, slots: float) -> None:
    assert "common to all flashes" not in remarks(bench)
    by_s = slots * bench.slot_s
    steps = tuple(replace(each, delay_s=each.delay_s + by_s) for each in bench.steps)
    said = remarks(replace(bench, steps=steps))
    assert f"seems to turn {slots:+.2f}" in said
    assert "check delay_s" in said
