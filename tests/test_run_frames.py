"""Coded frames in a run's folder: they come back as they were, or a message names the file."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from optsim.core.errors import OptsimError, StorageError, ValueCheckError
from optsim.core.files import read_exr, write_exr
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.experiment.measurement.runs import read_frames
from optsim.experiment.run_folder import CHECKSUMS, write_checksums, write_frames
from optsim.optics.readings import brightest, mean_reading

CCD, CODE = (9, 12), (3, 4, 5)


def frames() -> list[CodedFrame]:
    rng = np.random.default_rng(5)
    return [
        CodedFrame(
            index,
            rng.integers(0, 2**14, CCD).astype(np.uint16),
            ExposureCode(rng.integers(0, 256, CODE).astype(np.uint8), rng.random(CODE[1:]) < 0.5),
        )
        for index in range(2)
    ]


def write(folder: Path, taken: dict[str, list[CodedFrame]]) -> None:
    write_frames(folder, taken)
    write_checksums(folder)


def read(folder: Path) -> list[CodedFrame]:
    return read_frames(folder, "m", 2, CCD, CODE)


def test_frames_come_back_as_they_were(tmp_path: Path) -> None:
    write(tmp_path, {"m": frames(), "other": frames()[:1]})
    for before, after in zip(frames(), read(tmp_path), strict=True):
        assert before.index == after.index
        np.testing.assert_array_equal(before.dn, after.dn)
        np.testing.assert_array_equal(before.code.levels, after.code.levels)
        np.testing.assert_array_equal(before.code.moving, after.code.moving)


def pixels(path: Path, change) -> None:
    with Image.open(path) as picture:
        stored = np.asarray(picture)
    Image.fromarray(np.ascontiguousarray(change(stored.astype(np.uint16)))).save(path)


def levels(path: Path, change) -> None:
    write_exr(path, change({name: image + 0 for name, image in read_exr(path)[0].items()}), attributes={})


DN, MASK, CODES = "frames/m/000001.png", "masks/m/000001.png", "codes/m/000001.exr"


@pytest.mark.parametrize("listed", [False, True], ids=["", "listed anew"])
@pytest.mark.parametrize(
    ("name", "damage", "said"),
    [
        (DN, Path.unlink, "got 1 frames of 'm', expected 2"),
        (DN, lambda p: p.rename(p.with_name("000007.png")), "expected 2, numbered from 0"),
        (DN, lambda p: shutil.copy(p, p.with_name("000002.png")), "got 3 frames.*expected 2"),
        (DN, lambda p: p.write_bytes(b""), "cannot be read as PNG"),
        (DN, lambda p: p.write_bytes(p.read_bytes()[:90]), "cannot be read as PNG"),
        (DN, lambda p: pixels(p, lambda a: a[:4, :4]), "uint16 of 4 x 4, expected uint16 of 9 x 12"),
        (DN, lambda p: pixels(p, lambda a: np.pad(a, ((0, 0), (4, 0)))), "of 9 x 16, expected"),
        (DN, lambda p: pixels(p, lambda a: np.roll(a, 4, axis=1)), None),
        (DN, lambda p: pixels(p, lambda a: (a >> 8).astype(np.uint8)), "got uint8 .* expected uint16"),
        (DN, lambda p: pixels(p, lambda a: np.stack([a] * 3, -1).astype(np.uint8)), "3 channels, .*grey"),
        (MASK, Path.unlink, "no such file"),
        (MASK, lambda p: p.write_text("hello"), "cannot be read as PNG"),
        (MASK, lambda p: pixels(p, lambda a: a[:, :4].astype(np.uint8)), "of 4 x 4, expected uint8 of 4 x 5"),
        (MASK, lambda p: pixels(p, lambda a: 255 - a.astype(np.uint8)), None),
        (CODES, Path.unlink, "no such file"),
        (CODES, lambda p: p.write_bytes(p.read_bytes()[:200]), "cannot be read"),
        (CODES, lambda p: levels(p, lambda c: {k: v[:3] for k, v in c.items()}), "3 x 5, .*of 3 x 4 x 5"),
        (CODES, lambda p: levels(p, lambda c: {"slot00": c["slot00"]}), "of 4 x 5, expected .*of 3 x 4 x 5"),
        (CODES, lambda p: levels(p, lambda c: {k: v + 0.5 for k, v in c.items()}), "no whole numbers"),
        (CODES, lambda p: levels(p, lambda c: {k: 255 - v for k, v in c.items()}), None),
    ],
)
def test_a_damaged_or_changed_file_is_named(
    name: str, damage: Any, said: str | None, listed: bool, tmp_path: Path
) -> None:
    """Once checksums are of the changed files, none can tell other pixels from those of the run."""
    write(tmp_path, {"m": frames()})
    damage(tmp_path / name)
    if listed:
        write_checksums(tmp_path)
        if said is None:
            assert len(read(tmp_path)) == 2
            return
    elif said is None or not ("frames" in said or "numbered" in said):
        gone = not (tmp_path / name).exists()
        said = f"got {'no such file' if gone else 'other content'}, expected .* 9 x 12 pixels.* 3 x 4 x 5"
    with pytest.raises(OptsimError, match=said) as caught:
        read(tmp_path)
    assert "numbered from 0" in str(caught.value) or name in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no such file"),
        ("{", "not valid JSON"),
        ("{}", "got other content"),
        (json.dumps({DN: [1, 2]}), "got other content"),
    ],
)
def test_a_damaged_list_of_checksums_is_named(text: str | None, said: str, tmp_path: Path) -> None:
    write(tmp_path, {"m": frames()})
    (tmp_path / CHECKSUMS).unlink()
    if text is not None:
        (tmp_path / CHECKSUMS).write_text(text)
    with pytest.raises(StorageError, match=said):
        read(tmp_path)


def test_a_reading_off_the_image_is_an_error_and_one_at_its_border_is_not() -> None:
    image = np.arange(12, dtype=np.uint16).reshape(3, 4)
    row, col = np.array([[0, 2]]), np.array([[3, 3]])
    np.testing.assert_array_equal(mean_reading(image, row, col, 1), [[3, 11]])
    np.testing.assert_array_equal(brightest(image, row, col, 3), [[7, 11]])
    for cut in (image[:2], image[:, :3]):
        with pytest.raises(ValueCheckError, match=r"got . x . CCD pixels, expected at least 3 x 4"):
            mean_reading(cut, row, col, 1)
    with pytest.raises(ValueCheckError, match="expected at least"):
        brightest(image, row - 1, col, 1)
