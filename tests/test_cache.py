"""The cache: whole entries or none, memory-mapped, capped, and never fatal."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from optsim.core import compiled
from optsim.core.cache import Cache, hash_of
from optsim.core.errors import ConfigError, StorageError


def entry(size: int = 10) -> dict[str, np.ndarray]:
    return {"light": np.arange(size, dtype=np.float32)}


def test_makes_once_then_reads(tmp_path):
    cache, calls = Cache(tmp_path), []

    def make():
        calls.append(1)
        return entry()

    first = cache.get(hash_of("a"), make)
    again = Cache(tmp_path).get(hash_of("a"), make)
    assert calls == [1]
    assert isinstance(again["light"], np.memmap)
    np.testing.assert_array_equal(first["light"], again["light"])


def test_an_interrupted_write_leaves_no_entry(tmp_path):
    cache = Cache(tmp_path)

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cache.get("abcd", interrupted)
    assert "abcd" not in cache
    assert cache.get("abcd", entry)["light"].size == 10


def elsewhere(folder, program: str) -> subprocess.Popen:
    """Another process that does something with a cache, by the names ``cache`` and ``entry``."""
    start = (
        "import sys, numpy as np\nfrom pathlib import Path\nfrom optsim.core.cache import Cache\n"
        "cache = Cache(Path(sys.argv[1]))\nentry = lambda: {'light': np.arange(1000, dtype=np.float32)}\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", start + program, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def test_least_recently_used_goes_first_and_entries_in_use_stay(tmp_path):
    elsewhere(tmp_path, "for key in ('aa1', 'bb2', 'cc3'): cache.get(key, entry)").communicate()
    for place, key in enumerate(("aa1", "bb2", "cc3")):
        os.utime(tmp_path / "entries" / key[:2] / key, (100 + place, 100 + place))
    # Four entries of about 4.1 kB; the cap has room for three.
    young = Cache(tmp_path, cap_bytes=13_000)
    young.read("aa1")
    young.get("dd4", lambda: entry(1000))
    assert "bb2" not in young
    assert all(key in young for key in ("aa1", "cc3", "dd4"))


def test_an_entry_that_a_live_process_uses_is_not_evicted(tmp_path):
    held = [tmp_path / "entries" / key[:2] / key for key in ("aa1", "bb2", "cc3")]
    other = elsewhere(tmp_path, "cache.get('aa1', entry); print('made', flush=True); input()")
    assert other.stdout.readline() == "made\n"
    small = Cache(tmp_path, cap_bytes=1)
    small.get("bb2", entry)
    # Nor does another cache of one process evict what it uses.
    Cache(tmp_path, cap_bytes=1).get("cc3", entry)
    assert all(each.is_dir() for each in held)
    other.communicate("\n")
    small.get("dd4", entry)
    assert [each.is_dir() for each in held] == [False, True, True]


def test_what_is_taken_away_or_changed_says_what_to_do(tmp_path):
    cache = Cache(tmp_path)
    with pytest.raises(StorageError, match="run again"):
        cache.read("ff00")
    cache.get("ee11", entry)
    Cache(tmp_path).clear()
    with pytest.raises(StorageError, match=r"ee11 is missing .*while in use; cure: run again"):
        cache.read("ee11")


def zeroed(path):
    """Some pixels of 0 in an entry whose size stays."""
    array = np.load(path)
    array[3:5] = 0
    np.save(path, array)
    os.utime(path, (100, 100))  # clocks of file systems stand still for milliseconds


@pytest.mark.parametrize(
    "damage",
    [
        zeroed,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-1]),
        Path.unlink,
        lambda path: (path.parent / "files.json").unlink(),
        lambda path: (path.parent / "files.json").write_text("[1"),
        lambda path: (path.parent / "files.json").write_text('{"light.npy": 3}'),
        lambda path: shutil.rmtree(path.parent),
        lambda path: [each.unlink() for each in path.parent.iterdir()],
    ],
)
def test_a_damaged_entry_counts_as_absent_and_is_made_again(tmp_path, damage):
    path = tmp_path / "entries" / "ee" / "ee11" / "light.npy"
    cache = Cache(tmp_path)
    cache.get("ee11", entry)
    damage(path)
    for user in (cache, Cache(tmp_path)):
        assert "ee11" not in user
        with pytest.raises(StorageError, match="cure: run again"):
            user.read("ee11")
    np.testing.assert_array_equal(cache.get("ee11", entry)["light"], entry()["light"])
    assert "ee11" in Cache(tmp_path)
    assert sorted(each.name for each in path.parent.iterdir()) == ["files.json", "light.npy"]


def test_a_file_among_the_entries_disturbs_nothing(tmp_path):
    cache = Cache(tmp_path, cap_bytes=1)
    cache.get("ee11", entry)
    (tmp_path / "entries" / "ee" / "notes.txt").write_text("mine")
    cache.get("ee22", entry)
    assert cache.show()["bytes"] == 2 * (10 * 4 + 128)


def test_a_user_without_a_home_is_told_what_chooses_the_cache(monkeypatch):
    monkeypatch.setenv("OPTSIM_CACHE", "~nosuchuser/x")
    with pytest.raises(ConfigError, match=r"OPTSIM_CACHE: got '~nosuchuser/x'.*cure: set OPTSIM_CACHE"):
        Cache()
    for name in ("OPTSIM_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nowhere)
    with pytest.raises(ConfigError, match=r"OPTSIM_CACHE: not set.*cure: set OPTSIM_CACHE"):
        Cache()


def test_show_and_clear(tmp_path):
    cache = Cache(tmp_path)
    assert cache.show()["entries"] == 0
    cache.get("1234", entry)
    assert cache.show()["entries"] == 1
    assert cache.clear() == 10 * 4 + 128  # the header of a .npy file is 128 bytes
    assert cache.show()["bytes"] == 0


def test_a_senseless_cap_is_named(monkeypatch):
    monkeypatch.setenv("OPTSIM_CACHE_MAX_GB", "plenty")
    with pytest.raises(ConfigError, match="OPTSIM_CACHE_MAX_GB"):
        Cache()


def test_equal_parts_hash_alike_and_others_do_not():
    assert hash_of({"a": 1, "b": [2]}) == hash_of({"b": [2], "a": 1})
    assert hash_of("ab", "c") != hash_of("a", "bc")


@pytest.mark.parametrize("writable", [True, False])
def test_compiled_code_is_kept_in_the_cache_where_the_package_cannot_be_written(
    tmp_path, monkeypatch, writable
):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path))
    monkeypatch.setattr(compiled.os, "access", lambda *_: writable)
    package = Path(compiled.__file__).parents[1]
    assert compiled.cache_folder() == (package if writable else tmp_path / "numba")
