"""A run that is stopped and goes on: as if it had never been stopped, without the work done before."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_footage_run import FOOTAGE, SMALL, recording
from typer.testing import CliRunner

from optsim.app import cli
from optsim.camera.camera import CodedCamera
from optsim.core.files import read_exr, read_json
from optsim.core.quantities import CodedFrame, ExposureCode, PanelState
from optsim.decoding import GaussianMixture
from optsim.experiment import job, resume
from optsim.experiment.experiment import Experiment, experiment_path, load_experiment
from optsim.experiment.resume import (
    UNFINISHED,
    cached_scores,
    cached_shot,
    keep_scores,
    n_shots,
    run_key,
    unfinished,
)
from optsim.metrics import FrameTally, PairTally, UncertaintyTally
from optsim.report.schema import Resumed

FRAMES = 4
QUICK = [
    *SMALL,
    f"n_frames={FRAMES}",
    "calibration=ideal",
    "methods.random.decoder.kind=gaussian_mixture",
    "methods.random.decoder.uncertainty=true",
    "methods.adaptive.decoder.moving.kind=gaussian_mixture",
    "save_reconstructions=['adaptive', 'random']",
]
METHODS = ("adaptive", "hdr_mosaic", "random")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demo experiment whose scene is a recording beside it."""
    folder = tmp_path_factory.mktemp("laboratory")
    np.save(folder / "shots.npy", recording())
    demo = experiment_path("demo").read_text()
    start, stop = demo.index("[scene]"), demo.index("[camera]")
    path = folder / "lab.toml"
    path.write_text(demo[:start] + FOOTAGE.format(path="shots.npy") + 'axes = "tyx"\n' + demo[stop:])
    return path


@pytest.fixture(scope="module")
def experiment(lab: Path) -> Experiment:
    loaded = load_experiment(str(lab), QUICK)
    chosen = tuple(method for method in loaded.methods if method.name in METHODS)
    return loaded.model_copy(update={"methods": chosen})


def stop_at(stage: str, done: int) -> Callable[[str, int, int], None]:
    """Ctrl-C as soon as so much of a stage is done."""

    def progress(now: str, so_far: int, _: int) -> None:
        if (now, so_far) == (stage, done):
            raise KeyboardInterrupt

    return progress


def same_numbers(one: object, other: object) -> None:
    """Compare what results hold: numbers to rounding, since threads add patches in any order."""
    if isinstance(one, dict) and isinstance(other, dict):
        assert one.keys() == other.keys()
        for key in one:
            same_numbers(one[key], other[key])
    elif isinstance(one, list) and isinstance(other, list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            same_numbers(a, b)
    elif isinstance(one, float) and isinstance(other, float):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-12)
    else:
        assert one == other


@pytest.mark.slow
def test_a_run_stopped_three_times_is_the_run_that_nobody_stopped(
    experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, whole = tmp_path / "stopped", tmp_path / "whole"
    job.execute(experiment, whole)
    exposed: list[int] = []
    expose = CodedCamera.expose

    def counted(camera: CodedCamera, truth: Any, index: int, *rest: Any) -> Any:
        exposed.append(index)
        return expose(camera, truth, index, *rest)

    monkeypatch.setattr(CodedCamera, "expose", counted)
    for stage, done in (("capture", 1), ("decode", 1)):
        with pytest.raises(KeyboardInterrupt):
            job.execute(experiment, folder, progress=stop_at(stage, done))
    assert exposed == [k for k in range(FRAMES) for _ in METHODS], "each of them once"
    asked: list[tuple[int, bool]] = []
    partials = GaussianMixture.partials

    def watched(decoder: GaussianMixture, frames: Iterable[CodedFrame], known: Any) -> Any:
        def seen() -> Iterator[CodedFrame]:
            for frame in frames:
                asked.append((frame.index, bool(frame.code.moving.any())))
                yield frame

        return partials(decoder, seen(), known)

    # All is scored, but pictures are of the last frame and the worst.
    with pytest.raises(KeyboardInterrupt):
        job.execute(experiment, folder, progress=stop_at("decode", FRAMES))
    monkeypatch.setattr(GaussianMixture, "partials", watched)
    results = job.execute(experiment, folder)
    assert len(exposed) == FRAMES * len(METHODS)
    assert results.resumed == Resumed(captured=FRAMES, scored=FRAMES - 1)
    assert f"had been taken, {FRAMES - 1} of them decoded" in (folder / "report.html").read_text()

    told = read_json(whole / "results.json")
    shown = [frame["index"] for frame in told["viewer"]["frames"]]
    assert shown[0] == FRAMES - 1
    assert [frame.index for frame in results.viewer.frames] == shown
    assert {index for index, video in asked if video} == set(shown)
    assert told["resumed"] == {"captured": 0, "scored": 0}
    assert "had been taken" not in (whole / "report.html").read_text()
    series = ["frame_series", "slot_series"]
    for key in ("scores", "coverage", *series, "uncertainty", "masks", "pooled_masks", "photons"):
        same_numbers(read_json(folder / "results.json")[key], told[key])
    assert {u["method"] for u in told["uncertainty"]} == set(METHODS)
    files = sorted(p.relative_to(whole) for p in whole.rglob("*") if p.is_file())
    assert sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file()) == files
    for file in files:
        if file.parts[0] in ("frames", "masks"):
            assert (folder / file).read_bytes() == (whole / file).read_bytes()
        elif file.parts[0] == "reconstructions":
            (one, _), (other, _) = read_exr(folder / file), read_exr(whole / file)
            for slot, light in one.items():
                np.testing.assert_allclose(light, other[slot], rtol=2e-3, atol=1e-6)


def code(level: int) -> ExposureCode:
    return ExposureCode(np.full((36, 2, 3), level, np.uint8), np.zeros((2, 3), np.bool_))


def shot(index: int) -> tuple[CodedFrame, PanelState]:
    rng = np.random.default_rng(index)
    dn = rng.integers(0, 2**14, (8, 9)).astype(np.uint16)
    panel = PanelState(rng.random((2, 3), np.float32), np.full((2, 3), 7, np.uint8), 36 * (index + 1))
    return CodedFrame(index, dn, code(index), 5), panel


def never() -> tuple[CodedFrame, PanelState]:
    pytest.fail("taken again")


def test_shots_come_back_to_the_bit(tmp_path: Path) -> None:
    kept = unfinished(tmp_path, "key")
    for index in range(3):
        cached_shot(kept, "one", index, code(index), lambda k=index: shot(k))
    cached_shot(kept, "other", 0, code(0), lambda: shot(9))
    assert (n_shots(kept, ["one"]), n_shots(kept, ["one", "other"]), n_shots(kept, ["third"])) == (3, 1, 0)
    frame, panel = cached_shot(unfinished(tmp_path, "key"), "one", 2, code(2), never)
    expected, after = shot(2)
    np.testing.assert_array_equal(frame.dn, expected.dn)
    np.testing.assert_array_equal(frame.code.levels, expected.code.levels)
    assert (frame.index, frame.negative_light, frame.dn.dtype) == (2, 5, np.uint16)
    np.testing.assert_array_equal(panel.retardance_rad, after.retardance_rad)
    np.testing.assert_array_equal(panel.levels, after.levels)
    assert (panel.retardance_rad.dtype, panel.levels.dtype) == (np.float32, np.uint8)
    assert panel.slots_displayed == after.slots_displayed == 108
    # The same whether taken or recalled, in memory: the folder goes when the run is done.
    shutil.rmtree(tmp_path)
    assert not isinstance(frame.dn, np.memmap)
    assert frame.dn.flags.writeable


def test_what_another_key_kept_or_is_damaged_is_as_good_as_absent(tmp_path: Path) -> None:
    cached_shot(unfinished(tmp_path, "key"), "one", 0, code(0), lambda: shot(0))
    assert n_shots(unfinished(tmp_path, "other"), ["one"]) == 0
    frame, _ = cached_shot(unfinished(tmp_path, "other"), "one", 0, code(0), lambda: shot(4))
    np.testing.assert_array_equal(frame.dn, shot(4)[0].dn)
    kept = unfinished(tmp_path, "key")
    assert n_shots(kept, ["one"]) == 1
    (page,) = (tmp_path / UNFINISHED / "key").rglob("dn.npy")
    page.write_bytes(page.read_bytes()[:-10])
    assert n_shots(kept, ["one"]) == 0
    cached_shot(kept, "one", 0, code(0), lambda: shot(1))
    np.testing.assert_array_equal(cached_shot(kept, "one", 0, code(0), never)[0].dn, shot(1)[0].dn)


def test_scores_come_back_to_the_bit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def tally(method: str, index: int) -> FrameTally:
        counts = rng.integers(0, 1000, (4, 2, 36))
        return FrameTally(method, index, rng.random((3, 2, 36)), *counts, rng.integers(0, 9, (3, 2)))

    def spread(method: str, index: int) -> UncertaintyTally:
        counts = rng.integers(0, 9, 2)
        return UncertaintyTally(method, index, rng.random(2), rng.integers(0, 9, (2, 2)), counts)

    def pair(method: str, index: int) -> PairTally:
        return PairTally(method, index, rng.random((2, 2, 3, 2, 2)), rng.integers(0, 9, (2, 2, 2)))

    kept, methods = unfinished(tmp_path, "key"), ["one", "other"]
    made = [[tally("one", k), tally("other", k), pair("other", k), spread("other", k)] for k in range(3)]
    for index in (0, 1, 2):
        keep_scores(kept, methods, index, made[index])
    found = cached_scores(kept, methods)
    assert len(found) == 3
    for index, (these, those) in enumerate(zip(found, made, strict=True)):
        for a, b in zip(these, those, strict=True):
            assert type(a) is type(b)
            assert (a.method, a.index) == (b.method, index)
            for name, array in vars(b).items():
                np.testing.assert_array_equal(getattr(a, name), array)
                assert np.asarray(getattr(a, name)).dtype == np.asarray(array).dtype
    # As far as they go without a gap, and of these very methods.
    second = sorted(tmp_path.rglob("0.FrameTally.sums.npy"), key=lambda path: path.stat().st_mtime_ns)[1]
    second.unlink()
    assert len(cached_scores(kept, methods)) == 1
    assert cached_scores(kept, [*methods, "third"]) == []


def test_whatever_decides_a_run_s_numbers_decides_its_key(
    lab: Path, experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prior = tmp_path / "mine.npz"
    prior.write_bytes(b"one")
    named = [*QUICK, f"methods.random.decoder.mixture='{prior}'"]

    def key(assignments: list[str], *further: object) -> str:
        return run_key(load_experiment(str(lab), assignments), *further)

    first = {key(QUICK), key(QUICK, "another renderer"), key([*QUICK, "seed=2"]), key(named)}
    assert len(first) == 4
    assert key(QUICK) in first
    prior.write_bytes(b"two")
    assert key(named) not in first, "the same name, another content"
    monkeypatch.setattr(resume, "hash_files", lambda _: "other code")
    assert key(QUICK) not in first
    monkeypatch.undo()
    shots = lab.parent / "shots.npy"
    before = shots.read_bytes()
    try:
        np.save(shots, recording() // 2)
        assert key(QUICK) not in first, "another recording"
    finally:
        shots.write_bytes(before)
    assert key(QUICK) in first


def test_ctrl_c_says_how_to_go_on(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    execute = job.execute
    folder = tmp_path / "stopped"

    def stopped(*given: Any, **named: Any) -> Any:
        return execute(*given, **{**named, "progress": stop_at("capture", 1)})

    monkeypatch.setattr(job, "execute", stopped)
    settings = [word for one in QUICK for word in ("--set", one)]
    found = CliRunner().invoke(cli.app, ["run", str(lab), "--out", str(folder), *settings])
    assert found.exit_code == 130
    assert f"--out {folder}" in "".join((found.output, *capsys.readouterr())).replace("\n", "")
