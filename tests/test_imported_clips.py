"""Footage of one's own as clips to learn from: what its values mean, what is refused, what is remembered."""

import json

import numpy as np
import pytest
from PIL import Image
from recorded import codes16, colours, write_video
from scipy.io import savemat

from optsim.core.errors import ConfigError, StorageError, ValueCheckError
from optsim.core.files import write_exr, write_png16
from optsim.experiment.train import train_prior
from optsim.footage.clips import open_clips
from optsim.priors.dictionary import load_dictionary

SLOTS, SIDE = 36, 12
REC709 = np.array([0.2126, 0.7152, 0.0722])


def light(n=SLOTS, rows=SIDE, cols=SIDE + 2):
    """Linear light 0 .. 1, array (t, y, x): no two frames, rows or columns alike."""
    return np.random.default_rng(5).uniform(0.02, 0.98, (n, rows, cols))


def encoded(values):
    """Values as the sRGB standard writes them, 8 bits."""
    curve = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    return np.rint(255 * curve).astype(np.uint8)


def clip_of(path, **keys):
    (opened,) = open_clips([path], **keys)
    return opened.read()


def same_light(found, expected, error=1e-5):
    """Clips are the same light where they are in proportion: learning knows no scale."""
    assert found.dtype == np.float32
    assert found.shape == expected.shape
    np.testing.assert_allclose(found / found.mean(), expected / expected.mean(), atol=error)


def pictures(folder, frames, write):
    folder.mkdir(exist_ok=True)
    for k, frame in enumerate(frames):
        write(folder / f"shot{k}", frame)
    return folder


# --- what values mean -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["npz", "npy", "mat", "exr", "png16", "png8", "png8 linear", "colour"])
def test_every_kind_of_file_gives_the_clip_of_the_array(kind, tmp_path):
    values, path, error = light(), tmp_path / f"clip.{kind}", 1e-5
    expected, keys = values, {}
    if kind == "npz":
        np.savez(path, film=values)
    elif kind == "npy":
        np.save(path, values)
    elif kind == "mat":
        savemat(path, {"film": values.transpose(1, 2, 0)})
    elif kind == "exr":
        pictures(
            path,
            values,
            lambda p, f: write_exr(p.with_suffix(".exr"), {"Y": f.astype(np.float32)}, attributes={}),
        )
    elif kind == "png16":
        pictures(path, codes16(values), lambda p, f: write_png16(p.with_suffix(".png"), f))
        error = 4e-5
    elif kind == "png8":
        # Half a step of 8 bits, where the curve is steepest.
        pictures(path, encoded(values), lambda p, f: Image.fromarray(f).save(p.with_suffix(".png")))
        error = 0.5 / 255 * 2.4 / 1.055 / values.mean() + 1e-3
    elif kind == "png8 linear":
        codes = np.rint(255 * values).astype(np.uint8)
        pictures(path, codes, lambda p, f: Image.fromarray(f).save(p.with_suffix(".png")))
        expected, keys = codes.astype(np.float64), {"linearisation": "linear"}
    else:
        path = path.with_suffix(".npy")
        np.save(path, colours(values).astype(np.float32))
        expected = colours(values) @ REC709
    same_light(clip_of(path, **keys), expected, error)


@pytest.mark.parametrize(("pixels", "whole"), [("gray", np.uint8(1)), ("gray16le", np.uint16(257))])
def test_a_video_of_any_depth_is_read_as_encoded(pixels, whole, tmp_path):
    codes = encoded(light())
    write_video(tmp_path / "film.mkv", whole * codes, "ffv1", pixels, pixels)
    np.save(tmp_path / "film.npy", codes)
    same_light(clip_of(tmp_path / "film.mkv"), clip_of(tmp_path / "film.npy"))


def test_slots_are_means_of_linear_frames_and_the_rest_is_left_out(tmp_path):
    values = light(3 * SLOTS + 2)
    np.save(tmp_path / "fast.npy", encoded(values))
    found = clip_of(tmp_path / "fast.npy", frames_per_slot=3)
    one_by_one = clip_of(tmp_path / "fast.npy")
    expected = one_by_one[: 3 * SLOTS].reshape(SLOTS, 3, *values.shape[1:]).mean(axis=1)
    same_light(found, expected, 1e-6)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_black_level_is_no_light(tmp_path):
    values = 64 + np.rint(900 * light()).astype(np.uint16)
    np.save(tmp_path / "raw.npy", values)
    same_light(clip_of(tmp_path / "raw.npy", black_level=64), values - 64.0)


# --- what is refused, before anything is learned ----------------------------------------------------------


def saved(folder, values):
    path = folder / "clip.npy"
    np.save(path, values)
    return path


@pytest.mark.parametrize(
    ("values", "keys", "error", "message"),
    [
        (light(35), {}, ConfigError, "got 35 frames, 35 slots at --frames-per-slot 1, expected at least 36"),
        (light(100), {"frames_per_slot": 4}, ConfigError, "25 slots .* 144 frames; cure: .*fewer frames a"),
        (light(rows=7), {}, ConfigError, "got 7 x 14 pixels, expected at least 8 x 8"),
        (np.repeat(light()[..., None], 2, 3), {}, ConfigError, "got 2 channels, expected 1 or 3"),
        (light()[0], {}, ValueCheckError, "expected the axes tyx or tyxc"),
        (
            light(),
            {"linearisation": "srgb"},
            ConfigError,
            "--linearisation srgb: .*cure: --linearisation lin",
        ),
        (encoded(light()), {"black_level": 9}, ConfigError, "--black-level 9: .* is read as srgb"),
        (light() > 0.5, {}, ValueCheckError, "holds bool"),
    ],
)
def test_what_cannot_teach_is_refused_with_the_cure(values, keys, error, message, tmp_path):
    with pytest.raises(error, match=message):
        open_clips([saved(tmp_path, values)], **keys)


@pytest.mark.parametrize(
    ("values", "keys", "message"),
    [
        (np.where(light() > 0.9, np.nan, light()), {}, "not a finite number"),
        (light() - 0.2, {}, "state --black-level"),
        (np.full((SLOTS, 9, 9), 1e39), {}, "beyond what 32 bits can, 3.4e"),
        (np.zeros((SLOTS, 9, 9), np.uint16), {}, "no light above the black level"),
        (100 * light(), {"black_level": 90}, "below --black-level"),
    ],
)
def test_what_is_no_light_is_refused_when_it_is_read(values, keys, message, tmp_path):
    with pytest.raises(ValueCheckError, match=message):
        clip_of(saved(tmp_path, values), **keys)


def test_missing_files_several_arrays_and_lost_frames_are_said_of_the_option(tmp_path):
    with pytest.raises(StorageError, match=r"^--clips: no such file or folder"):
        open_clips([tmp_path / "none"])
    with pytest.raises(StorageError, match="no such file"):
        open_clips([tmp_path / "none.npz"])
    np.savez(tmp_path / "two.npz", a=light(), b=light())
    with pytest.raises(ConfigError, match=r"^--clips: expected one array.*two.npz holds a, b"):
        open_clips([tmp_path / "two.npz"])
    folder = pictures(
        tmp_path / "shots", encoded(light()), lambda p, f: Image.fromarray(f).save(p.with_suffix(".png"))
    )
    (folder / "shot7.png").unlink()
    with pytest.raises(StorageError, match=r"^--clips: after shot6.png comes shot8.png"):
        open_clips([folder])


# --- learning from it -------------------------------------------------------------------------------------


def test_a_prior_remembers_names_and_content_but_no_folders(tmp_path):
    frames = encoded(light(rows=24, cols=24))
    folder = pictures(tmp_path / "shots", frames, lambda p, f: Image.fromarray(f).save(p.with_suffix(".png")))
    np.save(tmp_path / "same.npy", frames)
    learned = {}
    for path in (folder, tmp_path / "same.npy"):
        clips = open_clips([path])
        out = tmp_path / f"{path.stem}.npz"
        assert train_prior("dictionary", out, size=12, clips=clips, method="ksvd") == out
        learned[path.name] = load_dictionary(out)
    (one, other) = learned.values()
    np.testing.assert_array_equal(one.atoms, other.atoms)
    for name, each in learned.items():
        (record,) = each.provenance["clips"]
        assert record["name"] == name
        assert record["linearisation"] == "srgb"
        assert each.provenance["method"].startswith("approximate K-SVD")
        assert each.provenance["command"] == (
            f"optsim train dictionary --size 12 --method ksvd --seed 1 --clips {name}"
        )
        assert "scene" not in each.provenance
        assert str(tmp_path) not in json.dumps(dict(each.provenance))
    hashes = {each.provenance["clips"][0]["sha256"] for each in learned.values()}
    (folder / "shot0.png").write_bytes((folder / "shot1.png").read_bytes())
    hashes.add(open_clips([folder])[0].record()["sha256"])
    assert len(hashes) == 3
