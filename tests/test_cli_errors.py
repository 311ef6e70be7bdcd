"""The last net: every error ends in one line and an exit code, whatever the output goes to."""

import os
import subprocess
import sys

import numpy as np
import pytest

from optsim.app.error_net import guarded
from optsim.core.config import override, read_toml
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_exr, read_json, write_exr, write_text


def raising(error):
    def command():
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ConfigError("key: got 1, expected 2"), "optsim: key: got 1, expected 2\n"),
        (KeyError("x"), "optsim: unexpected error: KeyError: KeyError 'x'; please report it"),
        (RecursionError("deep"), "unexpected error: RecursionError: deep"),
        (MemoryError("Unable to allocate 9 GiB"), "out of memory (Unable to allocate 9 GiB); cure:"),
        (OSError(12, "Cannot allocate memory"), "out of memory (Cannot allocate memory"),
        (RuntimeError("can't start new thread"), "out of memory (can't start new thread)"),
        (ImportError("a.so: failed to map segment from shared object"), "out of memory (a.so"),
        (OSError(28, "No space left on device"), "cannot write the output: No space left on device; cure:"),
        (PermissionError(13, "Permission denied", "a.npz"), "optsim: a.npz: Permission denied; choose"),
    ],
)
def test_one_line_says_what_stopped_it(error, said, capsys, monkeypatch):
    monkeypatch.delenv("OPTSIM_DEBUG", raising=False)
    monkeypatch.setattr("optsim.app.error_net._leave_stdout", lambda: None)
    assert guarded(raising(error)) == 2
    shown = capsys.readouterr().err
    assert said in shown
    assert shown.count("\n") == 1


def test_a_traceback_is_shown_only_on_request_and_only_of_the_unexpected(capsys, monkeypatch):
    monkeypatch.setenv("OPTSIM_DEBUG", "1")
    assert guarded(raising(KeyError("x"))) == 2
    assert "Traceback" in capsys.readouterr().err
    assert guarded(raising(ConfigError("x"))) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_exit_codes_pass(capsys):
    assert guarded(lambda: None) == 0
    assert guarded(lambda: 1) == 1
    assert guarded(lambda: 130) == 130
    assert "interrupted" in capsys.readouterr().err


def optsim(*words, **pipes):
    return subprocess.Popen([sys.executable, "-m", "optsim", *words], stderr=subprocess.PIPE, **pipes)


def test_a_full_disk_behind_stdout_and_a_reader_that_went_away():
    with open("/dev/full", "wb") as full:
        done = optsim("list", stdout=full)
        said = done.communicate()[1].decode()
    assert done.returncode == 2
    assert said.startswith("optsim: cannot write the output: No space left on device")
    assert said.count("\n") == 1
    read, write = os.pipe()
    os.close(read)
    done = optsim("list", stdout=write)
    os.close(write)
    assert done.communicate()[1] == b""
    assert done.returncode == 1


def test_images_that_fill_a_disk_are_named(tmp_path):
    """By another process, whose files may have 2000 bytes."""
    program = (
        "import resource, sys, numpy as np\nfrom pathlib import Path\n"
        "from optsim.core.errors import StorageError\n"
        "from optsim.core.files import write_exr, write_json, write_png16\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "big = np.random.default_rng(0).integers(0, 65536, (64, 64)).astype(np.uint16)\n"
        "for write in (lambda p: write_exr(p, {'Y': big.astype(np.float32)}, attributes={}),\n"
        "              lambda p: write_png16(p, big), lambda p: write_json(p, big.tolist())):\n"
        "    try: write(Path(sys.argv[1]) / 'big')\n"
        "    except StorageError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"cannot write {tmp_path / 'big'}: File too large\n" * 3
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "said"),
    [("9" * 5000, "thousands of digits"), ("[" * 3000, "nested too deep")],
)
def test_toml_and_json_that_parsers_refuse_in_other_words(text, said, tmp_path):
    (tmp_path / "a.toml").write_text(f"x = {text}\n")
    with pytest.raises(ConfigError, match=rf"a\.toml cannot be read as TOML: .*{said}"):
        read_toml(tmp_path / "a.toml")
    with pytest.raises(ConfigError, match=rf"--set 'x=.*{said}") as caught:
        override({}, [f"x={text}"])
    assert len(str(caught.value)) < 250
    (tmp_path / "a.json").write_text(text * 40)
    with pytest.raises(StorageError, match=r"a\.json is not valid JSON"):
        read_json(tmp_path / "a.json")


def test_a_byte_order_mark_is_passed_over(tmp_path):
    mark = b"\xef\xbb\xbf"
    (tmp_path / "a.toml").write_bytes(mark + b"x = 1\n")
    (tmp_path / "a.json").write_bytes(mark + b"[1]")
    assert read_toml(tmp_path / "a.toml") == {"x": 1}
    assert read_json(tmp_path / "a.json") == [1]


def test_names_that_are_not_utf8_are_written_and_read(tmp_path):
    folder = tmp_path / os.fsdecode(b"o\xff")
    image = np.arange(6, dtype=np.float32).reshape(2, 3)
    write_exr(folder / "a.exr", {"Y": image}, attributes={"frame": 1})
    channels, attributes = read_exr(folder / "a.exr")
    np.testing.assert_array_equal(channels["Y"], image)
    assert attributes == {"frame": 1}
    write_text(folder / "a.txt", f"in {folder.name}")
    assert (folder / "a.txt").read_text() == "in o\\udcff"
