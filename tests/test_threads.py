"""Work side by side: a thread for each core, one where asked, and never threads in threads."""

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from optsim.core import threads
from optsim.core.threads import in_bands, n_threads, one_thread, side_by_side, usable_cores


@pytest.fixture(autouse=True)
def three_cores(monkeypatch):
    monkeypatch.setattr(threads, "CORES", 3)


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_pieces_run_at_the_same_time_and_results_keep_their_order():
    meet = threading.Barrier(3, timeout=20)

    def piece(k):
        meet.wait()
        return k

    assert side_by_side(lambda k=k: piece(k) for k in range(3)) == [0, 1, 2]


def test_pieces_of_pieces_stay_in_their_thread():
    def outer():
        inner = side_by_side([threading.get_ident] * 4)
        return {threading.get_ident(), *inner}

    used = side_by_side([outer] * 3)
    assert [len(each) for each in used] == [1, 1, 1]
    assert threading.get_ident() not in set().union(*used)
    assert n_threads() == 3


def fail_alone():
    with one_thread():
        assert side_by_side([threading.get_ident] * 3) == [threading.get_ident()] * 3
        assert blas_threads() == {1}
        raise KeyError


def test_one_thread_holds_for_work_and_for_blas_until_its_end_even_after_an_error():
    before = blas_threads()
    with pytest.raises(KeyError):
        fail_alone()
    assert n_threads() == 3
    assert blas_threads() == before


@pytest.mark.parametrize("rows", [1, 2, 63, 64, 200])
def test_bands_cover_each_row_once_on_any_number_of_threads(rows):
    seen = np.zeros((2, rows), int)

    def count(which):
        def work(first, end):
            seen[which, first:end] += 1

        in_bands(rows, work, few=3)

    count(0)
    with one_thread():
        count(1)
    assert (seen == 1).all()


@pytest.mark.parametrize(
    ("files", "quota"),
    [
        ({"cpu.max": "150000 100000\n"}, 2),
        ({"cpu.max": "50000 100000\n"}, 1),
        ({"cpu.max": "max 100000\n"}, 64),
        ({"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 64),
        ({}, 64),
    ],
)
def test_cores_follow_the_affinity_and_the_quota_of_a_container(tmp_path, monkeypatch, files, quota):
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    for cores in (64, 2):
        monkeypatch.setattr(
            threads.os, "sched_getaffinity", lambda _, cores=cores: set(range(cores)), raising=False
        )
        assert usable_cores(tmp_path) == min(cores, quota)
