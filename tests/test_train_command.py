"""``optsim train``: wrong input is refused before any work, and a stopped training goes on."""

import numpy as np
import pytest
from test_cli import optsim as run

from optsim.experiment import train
from optsim.footage.clips import ImportedClip
from optsim.priors import training
from optsim.priors.dictionary import load_dictionary


@pytest.fixture
def optsim(capsys, monkeypatch, tmp_path):
    """The command line in a folder of its own that holds one good clip and one that is too short."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path / "cache"))
    frames = np.random.default_rng(3).random((36, 16, 16), dtype=np.float32) + 0.1
    np.save(tmp_path / "good.npy", frames)
    np.save(tmp_path / "short.npy", frames[:9])
    return lambda *words: run(capsys, monkeypatch, *words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--clips", "good.npy"), "--out: missing; what is learned from --clips would replace the shipped"),
        (("--clips", "good.npy", "--out", "mine.txt"), "expected a name that ends in .npz"),
        (
            ("--clips", "good.npy", "--out", "good.npy/mine.npz"),
            "good.npy is a file, expected a folder (--out)",
        ),
        (("--clips", "good.npy", "--clips", "short.npy", "--out", "mine.npz"), "short.npy: got 9 frames"),
        (("--frames-per-slot", "2", "--out", "mine.npz"), "--frames-per-slot: got without --clips"),
        (("--linearisation", "srgb", "--black-level", "3"), "--linearisation, --black-level: got without"),
        (("--clips", "good.npy", "--out", "mine.npz", "--frames-per-slot", "0"), "--frames-per-slot"),
        (("--clips", "good.npy", "--out", "mine.npz"), "usable patches, expected at least 4000"),
    ],
)
def test_wrong_input_is_refused_before_any_work(optsim, words, message, tmp_path, monkeypatch):
    for made in ("training_clips", "leaf_clips"):
        monkeypatch.setattr(train, made, lambda **_: pytest.fail("it made footage"))
    if "usable" in message:
        words = (*words, "--size", "2000")
        monkeypatch.setattr(training, "_PATCHES_AN_ATOM", 1)
    else:
        monkeypatch.setattr(ImportedClip, "read", lambda *_: pytest.fail("it read footage"))
    code, _, err = optsim("train", "dictionary", *words)
    assert code == 2
    assert message in " ".join(err.split())
    assert "Traceback" not in err
    assert not (tmp_path / "mine.npz").exists()


def test_a_file_that_is_there_is_not_replaced(optsim, tmp_path, monkeypatch):
    monkeypatch.setattr(ImportedClip, "read", lambda *_: pytest.fail("it read footage"))
    precious = tmp_path / "precious.npz"
    precious.write_bytes(b"a measurement")
    code, _, err = optsim("train", "dictionary", "--clips", "good.npy", "--out", str(precious))
    assert code == 2
    assert "exists already; choose another name" in err
    assert precious.read_bytes() == b"a measurement"


def test_a_mixture_has_no_method(optsim):
    code, _, err = optsim("train", "mixture", "--method", "ksvd", "--clips", "good.npy", "--out", "mine.npz")
    assert code == 2
    assert "--method ksvd: got it with a mixture" in err


def test_an_interrupted_training_says_how_to_go_on_and_does(optsim, tmp_path, monkeypatch):
    words = ("train", "dictionary", "--clips", "good.npy", "--size", "10")
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path / "another"))
    assert optsim(*words, "--out", "whole.npz")[0] == 0
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path / "cache"))
    calls = []
    update = training.least_squares_atoms

    def stopping(*args):
        calls.append(args)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return update(*args)

    monkeypatch.setattr(training, "least_squares_atoms", stopping)
    code, _, err = optsim(*words, "--out", "mine.npz")
    assert code == 130
    assert "the same command goes on" in err
    assert not (tmp_path / "mine.npz").exists()
    assert optsim(*words, "--out", "mine.npz")[0] == 0
    assert len(calls) == 6 + 7, "five of twelve iterations were not made again"
    np.testing.assert_array_equal(
        load_dictionary(tmp_path / "mine.npz").atoms, load_dictionary(tmp_path / "whole.npz").atoms
    )
