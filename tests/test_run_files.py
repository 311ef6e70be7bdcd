"""What a run writes is what it took and what it was shown: file by file, by the recording's own numbers."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_footage_run import COLS, FOOTAGE, PITCH, ROWS, SMALL

from optsim import render_truth
from optsim.core.files import read_exr, read_png16
from optsim.experiment import calibrations, job, loop
from optsim.experiment.experiment import Experiment, experiment_path, load_experiment
from optsim.experiment.figures import Figures

FRAMES = 3
STILL, SCALE = 0.4, 0.5


def recording() -> np.ndarray:
    """Two pictures a slot: even light, and a corner of 12 x 12 samples in which each slot has its own."""
    frames = np.full((FRAMES * 72, PITCH * ROWS, PITCH * COLS), STILL)
    frames[:, :12, :12] = 0.1 + 0.25 * np.arange(FRAMES * 72)[:, None, None] / (FRAMES * 72)
    return frames


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    folder = tmp_path_factory.mktemp("laboratory")
    np.save(folder / "film.npy", np.round(recording() * 65535).astype(np.uint16))
    demo = experiment_path("demo").read_text()
    start, stop = demo.index("[scene]"), demo.index("[camera]")
    (folder / "lab.toml").write_text(
        demo[:start] + FOOTAGE.format(path="film.npy") + 'axes = "tyx"\n' + demo[stop:]
    )
    settings = [*SMALL, f"n_frames={FRAMES}", "camera.effects.all=ideal", "save_reconstructions=['normal']"]
    settings += ["methods.random.decoder.kind=interpolation", "methods.adaptive.decoder.kind=hdr_merge"]
    settings += ["methods.normal.decoder.n_frames=1"]
    loaded = load_experiment(str(folder / "lab.toml"), settings)
    chosen = tuple(method for method in loaded.methods if method.name != "hdr_mosaic")
    return loaded.model_copy(update={"methods": chosen})


@pytest.fixture(scope="module")
def drawn() -> list[tuple[str, int, int]]:
    """Method, frame of its video and of its picture, as the figures were given them."""
    return []


@pytest.fixture(scope="module")
def folder(
    experiment: Experiment, drawn: list[tuple[str, int, int]], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    add = Figures.add

    def noted(figures: Figures, index: int, videos: dict[str, Any], frames: dict[str, Any]) -> None:
        drawn.extend((name, video.index, frames[name][index].index) for name, video in videos.items())
        add(figures, index, videos, frames)

    where = tmp_path_factory.mktemp("run") / "lab"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figures, "add", noted)
        job.execute(experiment, where, export_truth=True)
    return where


def test_frames_codes_and_masks_are_those_that_were_taken(folder: Path, experiment: Experiment) -> None:
    modelled, _ = loop.planned(experiment)
    known = calibrations.calibrate_all(modelled)
    radiance = render_truth(experiment)
    camera, _ = loop.set_light(modelled, radiance, known[experiment.calibration_choice])
    taken = loop.capture(modelled, camera, camera.form_image(radiance), known)
    for name, frames in taken.items():
        for index, frame in enumerate(frames):
            stem = f"{name}/{index:06d}"
            np.testing.assert_array_equal(read_png16(folder / "frames" / f"{stem}.png"), frame.dn)
            codes, said = read_exr(folder / "codes" / f"{stem}.exr")
            assert said["frame"] == index
            for slot, levels in enumerate(frame.code.levels):
                np.testing.assert_array_equal(codes[f"slot{slot:02d}"], levels)
    first, later = (taken["random"][k].dn for k in (0, 1))
    assert not np.array_equal(first, later), "or files of another frame would pass"


def test_the_exported_truth_is_the_recordings_mean_of_each_slot(folder: Path) -> None:
    slots = recording().reshape(FRAMES, 36, 2, ROWS, PITCH, COLS, PITCH).mean(axis=(2, 4, 6))
    for index, frame in enumerate(slots):
        channels, said = read_exr(folder / "truth" / f"{index:06d}.exr")
        assert said["frame"] == index
        for slot, light in enumerate(frame):
            # Sixteen bits.
            np.testing.assert_allclose(channels[f"slot{slot:02d}"], SCALE * light, atol=SCALE / 65535)


def test_a_written_reconstruction_is_the_scenes_radiance(folder: Path) -> None:
    """Whatever the density before the camera; a long exposure sees the mean of what changes."""
    channels, said = read_exr(folder / "reconstructions" / "normal" / "000002.exr")
    assert said["frame"] == 2
    light = channels["slot10"].astype(np.float64)
    # 144 pixels and more of some 5000 electrons, and 11 bits of a half float.
    assert light[8:, 8:].mean() == pytest.approx(SCALE * STILL, rel=0.005)
    changing = SCALE * recording()[2 * 72 :, 0, 0].mean()
    assert light[:3, :3].mean() == pytest.approx(changing, rel=0.02)


def test_pictures_show_video_and_frame_of_one_instant(
    folder: Path, drawn: list[tuple[str, int, int]]
) -> None:
    assert drawn == [(name, k, k) for k in range(FRAMES) for name in ("adaptive", "normal", "random")]
