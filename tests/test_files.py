"""The one guarded way out to disk."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.files import (
    atomic,
    read_exr,
    read_json,
    read_png16,
    writable_folder,
    write_exr,
    write_json,
    write_png16,
)


@pytest.mark.parametrize(
    "reorder",
    [
        lambda a: a,
        lambda a: a[::-1],
        lambda a: a[:, ::-1],
        lambda a: a[1:, 2:],
        lambda a: a.T,
        np.asfortranarray,
        lambda a: np.stack([a, -a], -1)[..., 0],
        lambda a: np.broadcast_to(a[:1], a.shape),
    ],
)
def test_exr_is_exact_for_every_memory_order(tmp_path: Path, reorder) -> None:
    """openexr#1929: the binding itself writes wrong pixels, without an error, for all but the first."""
    image = reorder(np.random.default_rng(1).normal(size=(11, 7)).astype(np.float32))
    write_exr(tmp_path / "a.exr", {"Y": image, "Z": 2 * image}, attributes={"unit": "W m^-2"})
    channels, attributes = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(channels["Y"], image)
    np.testing.assert_array_equal(channels["Z"], 2 * image)
    assert attributes == {"unit": "W m^-2"}


@settings(max_examples=25, deadline=None)
@given(
    hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=9),
        elements=st.floats(-(2.0**100), 2.0**100, width=32),
    )
)
def test_exr_round_trip_of_any_finite_image(tmp_path_factory: pytest.TempPathFactory, image) -> None:
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    write_exr(path, {"Y": image}, attributes={})
    np.testing.assert_array_equal(read_exr(path)[0]["Y"], image)


def test_half_keeps_eleven_bits_and_refuses_overflow(tmp_path: Path) -> None:
    image = np.geomspace(1e-4, 6e4, 64, dtype=np.float32).reshape(8, 8)
    write_exr(tmp_path / "h.exr", {"Y": image}, attributes={}, half=True)
    np.testing.assert_allclose(read_exr(tmp_path / "h.exr")[0]["Y"], image, rtol=2**-11)
    with pytest.raises(ValueCheckError, match="65504"):
        write_exr(tmp_path / "h.exr", {"Y": image * 2}, attributes={}, half=True)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((2, 2, 3), np.float32), "shape"),
        (np.zeros((2, 2)), "float64"),
        (np.full((2, 2), np.nan, np.float32), "not finite"),
        (np.zeros((0, 2), np.float32), "shape"),
    ],
)
def test_exr_refuses(tmp_path: Path, image, message: str) -> None:
    with pytest.raises(ValueCheckError, match=message):
        write_exr(tmp_path / "bad.exr", {"Y": image}, attributes={})
    assert list(tmp_path.iterdir()) == []


def test_png16_round_trip(tmp_path: Path) -> None:
    image = np.random.default_rng(2).integers(0, 2**16, (5, 9)).astype(np.uint16)[:, ::-2]
    write_png16(tmp_path / "a.png", image)
    np.testing.assert_array_equal(read_png16(tmp_path / "a.png"), image)


def test_json_refuses_nan_and_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueCheckError, match="null"):
        write_json(path, {"a": float("nan")})
    assert read_json(path) == {"a": 1}


def test_a_failed_write_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def fail_half_way() -> None:
        with atomic(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError, match="on purpose"):
        fail_half_way()
    assert [p.name for p in tmp_path.iterdir()] == ["kept.txt"]
    assert path.read_text() == "old"


def test_reading_what_is_not_there(tmp_path: Path) -> None:
    for reader in (read_exr, read_png16, read_json):
        with pytest.raises(StorageError, match="no such file"):
            reader(tmp_path / "none")
    (tmp_path / "junk.exr").write_text("junk")
    with pytest.raises(StorageError, match="cannot be read"):
        read_exr(tmp_path / "junk.exr")


def test_trying_a_folder_leaves_nothing_in_it(tmp_path: Path) -> None:
    assert writable_folder(tmp_path / "a" / "b", "--out", "choose another one") == tmp_path
    assert not list(tmp_path.iterdir())
