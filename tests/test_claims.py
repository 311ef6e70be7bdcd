"""Claims: of two processes that begin at once one works, and a dead one stands in nobody's way."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_experiment import SMALL
from typer.testing import CliRunner

from optsim.app.cli import app
from optsim.core import folder_claims as claims
from optsim.core.errors import StorageError
from optsim.core.files import write_new_text
from optsim.core.folder_claims import claimed, claimed_empty, claimed_file, free_folder, output_folder


def holder(place: Path) -> subprocess.Popen:
    """A process that holds a folder until it is told to go, or is killed."""
    program = (
        "import sys\nfrom pathlib import Path\nfrom optsim.core.folder_claims import claimed\n"
        "with claimed(Path(sys.argv[1])): print('held', flush=True); input()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    process = subprocess.Popen([sys.executable, "-c", program, str(place)], **pipes)
    assert process.stdout.readline() == "held\n"
    return process


def test_a_folder_that_another_process_holds_is_refused_until_that_ends(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "out"
    other = holder(folder)
    with pytest.raises(StorageError, match=rf"out is being written by process {other.pid} on .*--out"):
        claimed(folder).__enter__()
    other.communicate("\n")
    with claimed(folder):
        pass


def test_a_killed_process_leaves_a_folder_that_counts_as_empty(tmp_path: Path) -> None:
    other = holder(tmp_path / "out")
    other.kill()
    other.communicate()
    assert list((tmp_path / "out").iterdir())
    with claimed_empty(tmp_path / "out"):
        pass


def test_without_locks_the_process_that_is_named_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = holder(tmp_path)

    def none(*_: object) -> None:
        raise OSError(claims.errno.ENOTSUP, "no locks here")

    monkeypatch.setattr(claims.fcntl, "flock", none)
    with pytest.raises(StorageError, match=f"process {other.pid}"):
        claimed(tmp_path).__enter__()
    other.kill()
    other.communicate()
    with claimed(tmp_path):
        pass


def test_nothing_stays_of_a_claim_but_what_was_made_under_it(tmp_path: Path) -> None:
    def work(folder: Path, *, make: bool) -> None:
        with claimed(folder):
            if make:
                (folder / "result").touch()
            raise RuntimeError("on purpose")

    with pytest.raises(RuntimeError):
        work(tmp_path / "a" / "b", make=False)
    assert not list(tmp_path.iterdir())
    with pytest.raises(RuntimeError):
        work(tmp_path / "a" / "b", make=True)
    assert [each.name for each in (tmp_path / "a" / "b").iterdir()] == ["result"]


def test_what_holds_something_or_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").touch()
    with pytest.raises(StorageError, match="full is not an empty folder"):
        claimed_empty(tmp_path / "full").__enter__()
    for place in (tmp_path / "full" / "mine", tmp_path / "full" / "mine" / "below"):
        with pytest.raises(StorageError, match="mine"):
            claimed(place).__enter__()
    assert [each.name for each in (tmp_path / "full").iterdir()] == ["mine"]


def test_a_file_is_held_beside_others(tmp_path: Path) -> None:
    with (
        claimed_file(tmp_path / "a.npz"),
        claimed_file(tmp_path / "b.npz"),
        pytest.raises(StorageError, match=r"a\.npz is being written by process"),
    ):
        claimed_file(tmp_path / "a.npz").__enter__()
    assert not list(tmp_path.iterdir())


def test_new_folders_are_never_shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where several processes find the same name free."""
    monkeypatch.chdir(tmp_path)
    names = iter([Path("reports/runs/a"), Path("reports/runs/a"), Path("reports/runs/b")])
    with output_folder(None, "x") as kept:
        assert kept.is_dir()
        assert free_folder("x") != kept
        monkeypatch.setattr(claims, "free_folder", lambda _: next(names))
        with output_folder(None, "x") as one, output_folder(None, "x") as other:
            assert (one.name, other.name) == ("a", "b")
            (one / "result").touch()
        assert one.is_dir()
        assert not other.exists()
    assert not kept.exists()
    with output_folder(Path("mine"), "x") as folder:
        assert folder == Path("mine")
    assert not folder.exists()


def test_a_new_file_is_written_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_new_text(tmp_path / "a.toml", "mine")
    (tmp_path / "link.toml").symlink_to(tmp_path / "none")
    for name in ("a.toml", "link.toml"):
        with pytest.raises(StorageError, match=r"toml exists already; choose another name"):
            write_new_text(tmp_path / name, "theirs")
    assert (tmp_path / "a.toml").read_text() == "mine"

    def full(*_: object) -> None:
        raise StorageError("no space")

    monkeypatch.setattr("optsim.core.files.write_text", full)
    with pytest.raises(StorageError, match="no space"):
        write_new_text(tmp_path / "b.toml", "mine")
    assert not (tmp_path / "b.toml").exists()


@pytest.mark.parametrize(
    "line",
    [
        "run demo {sets} --out {out}",
        "render demo {sets} --out {out}",
        "render demo {sets} --passes --out {out}",
        "trace demo {sets} --pixel 20,20 --out {out}",
        "reconstruct {measurement} --out {out}",
        "benchmark --out {out}",
        "train dictionary --footage leaves --out {out}.npz",
    ],
)
def test_every_command_leaves_a_held_place_alone(line: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    np.savez(tmp_path / "m.npz", image=np.ones((4, 4)), code=np.ones((2, 4, 4)))
    words = {"sets": "SETS", "measurement": tmp_path / "m.npz", "out": out}
    arguments: list[str] = []
    for word in line.format(**words).split():
        sets = [part for each in (*SMALL, "calibration=true") for part in ("--set", each)]
        arguments += sets if word == "SETS" else [word]
    with (
        claimed(out),
        claimed_file(tmp_path / "out.npz"),
        pytest.raises(StorageError, match="is being written by process"),
    ):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert [each.name for each in tmp_path.iterdir()] == ["m.npz"]
