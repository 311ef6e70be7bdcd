"""A bench folder can be written, read back and, where it is broken, says which file and what to do."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_bench import Camera

from optsim.calibration import Bench, Flat, Patches, calibrate_from
from optsim.core.errors import BenchError
from optsim.core.files import read_png16, write_png16, write_tiff16


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bench")
    Camera(panel=(30, 40), ccd=(110, 140)).bench().write(path)
    return path


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(same, a, b))
    if hasattr(a, "dn"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b


def test_a_bench_survives_the_disk(folder: Path) -> None:
    bench = Camera(panel=(30, 40), ccd=(110, 140)).bench()
    back = Bench.read(folder)
    for field in fields(Bench):
        if field.name != "files":
            assert same(getattr(bench, field.name), getattr(back, field.name)), field.name
    assert back.files["dots[1]"] == tuple(str(folder / f"dots-01-{k:02d}.png") for k in (0, 1))
    assert calibrate_from(back).response == calibrate_from(bench).response


def test_a_bench_may_be_of_tiff_and_other_numbers_are_refused(folder: Path, tmp_path: Path) -> None:
    text = (folder / "bench.json").read_text()
    (tmp_path / "bench.json").write_text(text.replace(".png", ".tif"))
    for file in folder.glob("*.png"):
        write_tiff16(tmp_path / f"{file.stem}.tif", read_png16(file))
    there, here = Bench.read(folder), Bench.read(tmp_path)
    for (name, one), (_, two) in zip(there.groups(), here.groups(), strict=True):
        assert same(one, two), name
    assert same(there.darks, here.darks)
    dark = here.darks[0]
    for wrong, said in (
        (dark.astype(np.float32), "float32"),
        (dark.astype(np.uint8), "uint8"),
        (np.stack([dark, dark]), "2 pages"),
        (np.stack([dark] * 3, axis=-1), "3 channels"),
    ):
        tifffile.imwrite(tmp_path / "dark-00.tif", wrong)
        with pytest.raises(BenchError, match=rf"dark-00\.tif.*{said}.*lists it under darks"):
            Bench.read(tmp_path)
    (tmp_path / "dark-00.tif").write_bytes(b"II*\0")
    with pytest.raises(BenchError, match=r"dark-00\.tif cannot be read as TIFF"):
        Bench.read(tmp_path)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), height=st.integers(1, 9), width=st.integers(1, 9))
def test_any_image_survives_the_disk(
    tmp_path_factory: pytest.TempPathFactory, seed: int, height: int, width: int
) -> None:
    rng = np.random.default_rng(seed)
    dn = rng.integers(0, 65536, (2, height, width), np.uint16)
    flat = Flat(255, float(rng.random()), dn)
    patches = Patches((1, 2), (3,), 1, 1.0, dn)
    bench = Bench(0.005, 36, 28, (4, 5), dn, (flat,), flat, (), flat, (patches,) * 3, (patches,), (), ())
    path = tmp_path_factory.mktemp("any")
    bench.write(path)
    back = Bench.read(path)
    assert all(
        same(getattr(bench, f.name), getattr(back, f.name)) for f in fields(Bench) if f.name != "files"
    )


def broken(folder: Path, tmp_path: Path, **changes: object) -> Path:
    """A folder with the same images by absolute path and a changed record."""
    record = json.loads((folder / "bench.json").read_text())
    text = json.dumps({**record, **changes})
    for image in folder.glob("*.png"):
        text = text.replace(f'"{image.name}"', json.dumps(str(image)))
    (tmp_path / "bench.json").write_text(text)
    return tmp_path


def test_no_record(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"bench\.json.*needs bench\.json"):
        Bench.read(tmp_path)


def test_a_missing_image_is_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"gone\.png.*take it again"):
        Bench.read(broken(folder, tmp_path, darks=["gone.png"]))


def test_a_broken_image_is_named(folder: Path, tmp_path: Path) -> None:
    path = broken(folder, tmp_path, darks=["half.png", "half.png"])
    (path / "half.png").write_bytes((folder / "dark-00.png").read_bytes()[:99])
    with pytest.raises(BenchError, match=r"half\.png.*take it again"):
        Bench.read(path)


def test_an_image_of_the_wrong_size_is_named(folder: Path, tmp_path: Path) -> None:
    write_png16(tmp_path / "small.png", np.zeros((10, 12), np.uint16))
    listed = json.loads((folder / "bench.json").read_text())["darks"]
    with pytest.raises(BenchError, match=r"small\.png.*\(10, 12\).*expected \(110, 140\)"):
        Bench.read(broken(folder, tmp_path, darks=[*listed, "small.png"]))


def test_groups_of_different_size_are_refused(folder: Path, tmp_path: Path) -> None:
    write_png16(tmp_path / "small.png", np.zeros((10, 12), np.uint16))
    with pytest.raises(BenchError, match="same full CCD"):
        Bench.read(broken(folder, tmp_path, darks=["small.png", "small.png"]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"slot_s": "fast"}, "slot_s: got 'fast', expected a number"),
        ({"panel_shape": [30]}, "panel_shape: got .*expected a list of 2 whole"),
        ({"flats": [{"level": 255}]}, r"flats\[0\]\.irradiance_w_m2 is missing"),
        ({"flats": {}}, "flats: .*a list of objects"),
        ({"off": []}, "off: .*an object"),
        ({"darks": "all.png"}, "darks: .*a list of file names"),
        ({"format": "other"}, "format"),
        ({"anchors": []}, "anchors: got 0, expected at least 3"),
    ],
)
def test_a_wrong_record_names_the_key(
    folder: Path, tmp_path: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(BenchError, match=message):
        Bench.read(broken(folder, tmp_path, **changes))


def test_single_flats_are_refused() -> None:
    bench = Camera(panel=(30, 40), ccd=(110, 140)).bench()
    with pytest.raises(BenchError, match="pairs"):
        replace(bench, flats=(replace(bench.flats[0], dn=bench.flats[0].dn[:1]),))
