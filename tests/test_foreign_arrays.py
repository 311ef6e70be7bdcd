"""Arrays that others wrote: sizes that files declare are checked, damage and other contents are errors."""

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from recorded import codes16, signal, slots, truth
from scipy.io import savemat
from scipy.sparse import csc_matrix

from optsim.core.errors import OptsimError, StorageError, ValueCheckError
from optsim.footage.recording import array_names, load_array, open_recording
from optsim.priors.prior_file import read_prior, write_prior

FILM = np.random.default_rng(3).integers(0, 4000, (8, 6, 9)).astype(np.uint16)


def npy(array: np.ndarray, shape: tuple[int, ...] | None = None) -> bytes:
    """An npy file, of another shape in its header if one is given."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": array.dtype.str, "fortran_order": False, "shape": shape or array.shape}
    )
    return buffer.getvalue() + array.tobytes()


def npz(path: Path, compression: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


def patched(path: Path, local: int, central: int, value: bytes) -> Path:
    """Write a value at a place of each header of an archive's only member."""
    content = bytearray(path.read_bytes())
    for at in (content.index(b"PK\3\4") + local, content.index(b"PK\1\2") + central):
        content[at : at + len(value)] = value
    path.write_bytes(content)
    return path


def wrong_npz(path: Path, how: str) -> Path:
    good = npy(FILM)
    if how == "declared":
        return npz(path, image=npy(FILM, (10**6, 10**7)))
    if how == "declared less":
        return npz(path, image=npy(FILM, (4, 6, 9)))
    if how == "bomb":
        # 64 bytes of which the directory says that they are 4 TiB: more than deflate can do.
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, allowZip64=True) as archive:
            archive.writestr("image.npy", good)
        return patched(path, 22, 24, struct.pack("<I", 2**32 - 2))
    if how == "encrypted":
        return patched(npz(path, image=good), 6, 8, b"\1\0")
    if how == "deflate64":
        return patched(npz(path, image=good), 8, 10, b"\x09\0")
    if how == "checksum":
        return patched(npz(path, image=good), 14, 16, b"\1\2\3\4")
    if how == "byte":
        content = bytearray(npz(path, image=good).read_bytes())
        content[len(content) // 3] ^= 255
        path.write_bytes(content)
    elif how == "twice":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("image.npy", good)
            with pytest.warns(UserWarning, match="Duplicate"):
                archive.writestr("image.npy", npy(FILM + 1))
    elif how == "objects":
        np.savez(path, image=np.array([{}, None], object))
    elif how == "npy":
        path.write_bytes(good)
    elif how == "empty":
        path.write_bytes(b"")
    else:
        path.write_bytes(npz(path, image=good).read_bytes()[:-30])
    return path


@pytest.mark.parametrize(
    "how",
    [
        "declared",
        "declared less",
        "bomb",
        "encrypted",
        "deflate64",
        "checksum",
        "byte",
        "twice",
        "objects",
        "npy",
        "empty",
        "cut",
    ],
)
def test_what_is_wrong_with_an_archive_names_it(how: str, tmp_path: Path) -> None:
    path = wrong_npz(tmp_path / "a.npz", how)
    with pytest.raises(StorageError, match=r"a\.npz cannot be read as a numpy array of numbers"):
        load_array(path, "image")
    with pytest.raises(StorageError, match=r"a\.npz is not a dictionary: "):
        read_prior(path, "dictionary", ("image",))


def test_a_size_beyond_memory_is_refused_before_it_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("optsim.core.foreign.available_bytes", lambda: FILM.nbytes - 1.0)
    for path in (tmp_path / "a.npz", tmp_path / "a.mat"):
        np.savez(path, image=FILM) if path.suffix == ".npz" else savemat(path, {"image": FILM})
        with pytest.raises(StorageError, match="of memory that are free"):
            load_array(path, "image")


@pytest.mark.parametrize("shape", [(10**6, 10**7), (4, 6, 9), (9, 6, 9)])
def test_an_npy_holds_what_it_declares(shape: tuple[int, ...], tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(npy(FILM, shape))
    with pytest.raises(StorageError, match=rf"declares .* bytes, but {FILM.nbytes} are there"):
        open_recording(tmp_path / "a.npy", axes="tyx")


@pytest.mark.parametrize("order", ["big-endian", "Fortran"])
@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_any_order_of_bytes_and_axes_in_memory_is_the_same_film(
    order: str, suffix: str, tmp_path: Path
) -> None:
    values = codes16(signal())
    stored = values.astype(">u2") if order == "big-endian" else np.asfortranarray(values)
    path = tmp_path / f"a{suffix}"
    np.save(path, stored) if suffix == ".npy" else np.savez(path, image=stored)
    found = slots(truth(path, axes="tyx", full_scale=65535), tmp_path)
    assert np.allclose(found, 3.0 * values / 65535, atol=1e-6)
    if suffix == ".npz":
        assert load_array(path, "image").dtype == np.uint16


@pytest.mark.parametrize("values", [FILM * 1j, np.array(["a"]), FILM.astype("M8[s]"), np.zeros(3, "i4,f4")])
def test_an_array_of_something_else_is_refused(values: np.ndarray, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", image=values)
    with pytest.raises(ValueCheckError, match=r"image holds .* expected plain real numbers"):
        load_array(tmp_path / "a.npz", "image")


# --- MATLAB -------------------------------------------------------------------------------------------------

ODD = {
    "sparse": csc_matrix(FILM[0].astype(float)),
    "struct": {"a": 1.0},
    "cell": np.array([1, "a"], object),
    "char": "text",
    "complex128": FILM * 1j,
}


@pytest.mark.parametrize("kind", ODD)
def test_a_variable_that_is_no_full_real_array_is_refused(kind: str, tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"image": ODD[kind]})
    with pytest.raises(ValueCheckError, match=rf"a\.mat: image (is|holds) {kind}, expected"):
        load_array(tmp_path / "a.mat", "image")


def wrong_mat(path: Path, how: str) -> Path:
    savemat(path, {"image": FILM}, do_compression=how != "declared")
    content = bytearray(path.read_bytes())
    if how == "byte":
        content[len(content) // 2] ^= 255
    elif how == "declared":
        at = content.index(struct.pack("<3i", *FILM.shape))
        content[at : at + 12] = struct.pack("<3i", 10**6, 10**6, 9)
    elif how == "HDF5":
        content = bytearray(b"\x89HDF\r\n\x1a\n" + bytes(600))
    elif how == "empty":
        content = bytearray()
    elif how == "text":
        content = bytearray(b"nothing of the kind" * 20)
    else:
        content = content[: len(content) // 2]
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("how", ["byte", "declared", "cut", "HDF5", "empty", "text"])
def test_what_is_wrong_with_a_matlab_file_names_it(how: str, tmp_path: Path) -> None:
    path = wrong_mat(tmp_path / "a.mat", how)
    with pytest.raises(
        OptsimError, match=r"a\.mat (cannot be read as a MATLAB file|is of MATLAB's version 7\.3)"
    ):
        load_array(path, "image")


def test_matlab_arrays_are_read(tmp_path: Path) -> None:
    for compressed in (False, True):
        savemat(tmp_path / "a.mat", {"image": FILM, "mask": FILM > 9}, do_compression=compressed)
        assert array_names(tmp_path / "a.mat") == ["image", "mask"]
        assert np.array_equal(load_array(tmp_path / "a.mat", "image"), FILM)
        assert np.array_equal(load_array(tmp_path / "a.mat", "mask"), FILM > 9)


# --- our own ------------------------------------------------------------------------------------------------


def test_a_prior_is_read_back(tmp_path: Path) -> None:
    write_prior(tmp_path / "a.npz", {"atoms": FILM}, {"seed": 1})
    arrays, provenance = read_prior(tmp_path / "a.npz", "dictionary", ("atoms",))
    assert (provenance, np.array_equal(arrays["atoms"], FILM)) == ({"seed": 1}, True)
    with pytest.raises(StorageError, match=r"a\.npz is not a mixture: .*it holds no means"):
        read_prior(tmp_path / "a.npz", "mixture", ("means",))
