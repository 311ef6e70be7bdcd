"""The cache: whole entries or none, memory-mapped, capped, and never fatal."""

import os

import numpy as np
import pytest

from optsim.cache import Cache, hash_of
from optsim.errors import ConfigError, StorageError


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


def test_least_recently_used_goes_first_and_entries_in_use_stay(tmp_path):
    old = Cache(tmp_path)
    for place, key in enumerate(("aa1", "bb2", "cc3")):
        old.get(key, lambda: entry(1000))
        os.utime(tmp_path / "entries" / key[:2] / key, (100 + place, 100 + place))
    # Four entries of about 4.1 kB; the cap has room for three.
    young = Cache(tmp_path, cap_bytes=13_000)
    young.read("aa1")
    young.get("dd4", lambda: entry(1000))
    assert "bb2" not in young
    assert all(key in young for key in ("aa1", "cc3", "dd4"))


def test_a_missing_and_a_damaged_entry_say_what_to_do(tmp_path):
    cache = Cache(tmp_path)
    with pytest.raises(StorageError, match="run again"):
        cache.read("ff00")
    cache.get("ee11", entry)
    (tmp_path / "entries" / "ee" / "ee11" / "light.npy").write_bytes(b"")
    with pytest.raises(StorageError, match="delete this folder"):
        cache.read("ee11")


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
