"""A calibration's file comes back to the bit and says what it holds; damaged and foreign ones are refused."""

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from ideal_camera import ideal_calibration

from optsim.calibration import Calibration, Glare, read_calibration, write_calibration
from optsim.calibration.stored import calibration_arrays, calibration_of
from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.quantities import CodedFrame, ExposureCode


@pytest.fixture(scope="module")
def known() -> Calibration:
    """Every field unlike its default: five slots under three fields, rows that turn late, glare."""
    rng = np.random.default_rng(3)
    kernel = rng.random((9, 12, 3, 3)).astype(np.float32)
    plain = ideal_calibration(9, 12, leak=0.02, tau_s=4e-4)
    response = plain.response.model_copy(
        update={"field_drive": (1.02, 0.97, 1.01), "delay_s": 2e-4, "scan_s": 1e-3, "white_rad": 3.0}
    )
    return replace(
        plain,
        source="bench",
        response=response,
        valid=rng.random((9, 12)) < 0.9,
        responsivity_dn=rng.uniform(200, 300, (9, 12)).astype(np.float32),
        crosstalk=(kernel / kernel.sum(axis=(2, 3), keepdims=True)).astype(np.float32),
        gain_uncertainty=0.01,
        leak_uncertainty=0.02,
        map_residual_px=0.05,
        glare=Glare(0.01, 0.02, 11.0, (0.001, 0.002, 0.0, 0.003)),
        reading_px=3,
        standard_errors={"leak": 0.001, "map_px": 0.002},
        misalignment={"shift_y_px": -1.25, "rotation_rad": 0.008},
    )


@pytest.fixture(scope="module")
def written(known: Calibration, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("written") / "calibration.npz"
    write_calibration(path, known)
    return path.read_bytes()


@pytest.fixture
def path(written: bytes, tmp_path: Path) -> Path:
    (tmp_path / "calibration.npz").write_bytes(written)
    return tmp_path / "calibration.npz"


def test_every_field_comes_back_to_the_bit(known: Calibration, path: Path, tmp_path: Path) -> None:
    back = read_calibration(path)
    for field in fields(Calibration):
        ours, theirs = getattr(known, field.name), getattr(back, field.name)
        if isinstance(ours, np.ndarray):
            np.testing.assert_array_equal(ours, theirs, strict=True)
        else:
            assert ours == theirs, field.name
    write_calibration(tmp_path / "again.npz", back)
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes()


def test_the_share_that_is_no_glare_comes_back(known: Calibration, path: Path) -> None:
    """In the file, and in what is read of it: even light stays as it is, near and far light together."""
    back, even = read_calibration(path), np.ones(known.shape, np.float32)
    with np.load(path) as stored:
        np.testing.assert_array_equal(stored["direct_share"], known.direct_share, strict=True)
    np.testing.assert_array_equal(back.direct_share, known.direct_share, strict=True)
    assert 0.9 < back.direct_share.min() < back.direct_share.max() < 0.99
    np.testing.assert_allclose(
        back.mix_near(even), known.direct_share * known.spread(even[None])[0], rtol=1e-6
    )
    np.testing.assert_allclose(known.direct_share + back.mix_far(even), 1, rtol=1e-6)


def test_the_file_says_axes_and_unit_of_each_array(path: Path) -> None:
    with np.load(path) as stored:
        about = json.loads(str(stored["about"]))
        assert about["format"] == "optsim calibration 1"
        assert {*about["arrays"]} == {*stored.files} - {"about"}
        for name, said in about["arrays"].items():
            assert said["unit"]
            assert said["meaning"]
            axes = said["axes"].split(",") if said["axes"] and "(" not in said["axes"] else said["axes"]
            assert stored[name].ndim == (1 if isinstance(axes, str) and axes else len(axes)), name


def test_the_table_of_weights_holds_the_history_of_one_slot(known: Calibration, path: Path) -> None:
    """In codes of slots long beside the time constants nothing of the slot before last is left."""
    rng = np.random.default_rng(4)
    levels = rng.choice([0, 90, 255], (36, 9, 12)).astype(np.uint8)
    code = ExposureCode(levels, np.zeros((9, 12), np.bool_))
    slots = known.slots_per_frame
    levels = levels[:slots]
    _, panel = known.weights(ExposureCode(levels, code.moving), None)
    with np.load(path) as k:
        for index in range(2):
            earlier = np.concatenate([levels[-1:], levels[:-1]])
            field = ((index + 1) * slots + np.arange(slots))[:, None, None] % 3
            down = np.linspace(0, 1, 9)[:, None]
            first, last = (k["slot_weight"][field, end, earlier, levels] for end in (0, 1))
            mine = (1 - down) * first + down * last
            exact, panel = known.weights(ExposureCode(levels, code.moving), None if index == 0 else panel)
            np.testing.assert_allclose(mine[: known.coded_slots], exact[: known.coded_slots], atol=2e-3)


def edited(path: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    change(arrays)
    np.savez(path, **arrays)


def about(**changes: object) -> Callable[[dict[str, np.ndarray]], object]:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays["about"] = np.array(json.dumps({**json.loads(str(arrays["about"])), **changes}))

    return change


def set_at(name: str, place: tuple[int, ...], value: float) -> Callable[[dict[str, np.ndarray]], object]:
    return lambda arrays: arrays[name].__setitem__(place, value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("black_dn"), "got no black_dn"),
        (lambda a: a.pop("about"), "got a file of black_dn"),
        (about(format="optsim calibration 9"), "got 'optsim calibration 9', expected 'optsim calibration 1'"),
        (about(source="guess"), "expected 'optsim calibration 1'"),
        (
            about(standard_errors={"leak": -1}),
            "standard_errors.leak: got -1, expected a number of at least 0",
        ),
        (about(misalignment={"rotation_rad": "8"}), "misalignment.rotation_rad: got '8', expected a number;"),
        (about(misalignment=[]), r"misalignment: got \[\], expected a table"),
        (about(standard_errors=3), "standard_errors: got 3, expected a table"),
        (about(standard_errors=None), "standard_errors: got None, expected a table"),
        (set_at("responsivity_dn", (2, 3), np.nan), "responsivity_dn: got float32.*not finite"),
        (set_at("slot_weight", (0, 0, 1, 1), np.inf), "slot_weight: .*not finite"),
        (set_at("responsivity_dn", (2, 3), -1.0), "responsivity_dn.*negative"),
        (set_at("centre_row", (0, 0), 9), "centre_row: got CCD pixels 0 to 9"),
        (set_at("centre_col", (0, 0), -1), "centre_col: got CCD pixels -1"),
        (set_at("crosstalk", (0, 0, 0, 0), 5.0), "crosstalk"),
        (lambda a: a.update(valid=a["valid"][:-1]), "has shape"),
        (lambda a: a.update(valid=a["valid"].astype(np.float32)), "valid"),
        (lambda a: a.update(slot_weight=a["slot_weight"][:2]), r"slot_weight: got shape \(2, 2, 256, 256\)"),
        (lambda a: a.update(direct_share=a["direct_share"][:-1]), "direct_share: got shape"),
        (lambda a: a.update(leak=np.array(3.0)), "less than or equal to 1"),
        (lambda a: a.update(leak=np.array("dark")), "leak: got"),
        (lambda a: a.update(ccd_shape=np.array([9, 12, 1])), "ccd_shape"),
        (lambda a: a.update(reading_px=np.array(2)), "reading_px: got 2"),
        (lambda a: a.update(slot_s=np.array(0.0)), "slot_s: got 0"),
        (lambda a: a.update(coded_slots=np.array(99)), "coded_slots: got 99"),
        (lambda a: a.update(slots_per_frame=np.array(36.0)), "slots_per_frame: got float64"),
        (lambda a: a.update(glare_veil=np.array(2.0)), "glare"),
        (lambda a: a.update(black_dn=np.array([{}], dtype=object)), "cannot be read as a calibration"),
    ],
)
def test_what_is_not_whole_is_refused(
    path: Path, change: Callable[[dict[str, np.ndarray]], object], message: str
) -> None:
    edited(path, change)
    with pytest.raises(StorageError, match=message) as raised:
        read_calibration(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("place", [0.1, 0.5, 0.9])
def test_damage_is_refused(path: Path, place: float) -> None:
    whole = path.read_bytes()
    at = int(place * len(whole))
    for damaged in (whole[:at], whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :], b"", b"PK\x03\x04"):
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match=r"calibration\.npz cannot be read as a calibration"):
            read_calibration(path)
    with pytest.raises(StorageError, match="no such file"):
        read_calibration(path.with_name("gone.npz"))


def test_numbers_survive_a_cache_that_knows_no_scalars(known: Calibration) -> None:
    arrays = {name: np.ascontiguousarray(array) for name, array in calibration_arrays(known).items()}
    assert calibration_of(arrays, "the cache").response == known.response


def test_a_frame_of_another_ccd_is_refused(known: Calibration) -> None:
    code = ExposureCode(np.zeros((known.slots_per_frame, 9, 12), np.uint8), np.zeros((9, 12), np.bool_))
    for shape in ((9, 13), (10, 12), (12, 9), (8, 12)):
        with pytest.raises(ValueCheckError, match=r"frame 2: got .* pixels, expected \(9, 12\)"):
            known.observe(CodedFrame(2, np.zeros(shape, np.uint16), code))
