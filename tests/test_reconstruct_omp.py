"""Matching pursuit against a plain one; measurement matrices and overlap sums against their definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optsim.errors import StorageError, ValueCheckError
from optsim.reconstruct.dictionary import Dictionary, load_dictionary, save_dictionary, unit
from optsim.reconstruct.matching_pursuit import correlations, pursue
from optsim.reconstruct.patch_codes import PatchCoder, measurement_matrix, overlap, patch_corners
from optsim.reconstruct.training import train_dictionary


def plain_omp(matrix, signal, cap, stop):
    """Pick the best atom, fit all picked by least squares, repeat; float64."""
    picked, amounts, left = [], np.zeros(0), signal
    while len(picked) < cap and left @ left > stop:
        picked.append(int(np.argmax(np.abs(matrix.T @ left))))
        amounts = np.linalg.lstsq(matrix[:, picked], signal, rcond=None)[0]
        left = signal - matrix[:, picked] @ amounts
    return picked, amounts, left


def fast_omp(matrix, signals, cap, stop):
    width = matrix.shape[1]
    support = np.empty((len(signals), cap), np.int64)
    amounts = np.empty((len(signals), cap), np.float32)
    gram, known = np.empty((width, width), np.float32), np.zeros(width, np.bool_)
    pursue(matrix, signals, np.full(len(signals), stop, np.float32), gram, known, support, amounts)
    return support, amounts


def problem(rng, m, k, n):
    matrix = rng.standard_normal((m, k)).astype(np.float32)
    return matrix / np.linalg.norm(matrix, axis=0), rng.standard_normal((n, m)).astype(np.float32)


@settings(deadline=None)  # the first call compiles
@given(
    st.integers(3, 40), st.integers(2, 300), st.integers(1, 40), st.integers(1, 12), st.integers(0, 2**32 - 1)
)
def test_pursuit_equals_plain_pursuit(m, k, n, cap, seed):
    cap = min(cap, m - 1, k)
    matrix, signals = problem(np.random.default_rng(seed), m, k, n)
    support, amounts = fast_omp(matrix, signals, cap, 0.3)
    for p in range(n):
        picked, exact, left = plain_omp(matrix.astype(np.float64), signals[p].astype(np.float64), cap, 0.3)
        found = support[p][support[p] >= 0]
        rest = signals[p] - matrix[:, found].astype(np.float64) @ amounts[p, : len(found)]
        # Two atoms may tie within float32, and then another, as good, is picked: the residual decides.
        assert abs(np.linalg.norm(rest) - np.linalg.norm(left)) < 1e-3 * np.linalg.norm(signals[p]) or (
            list(found) != picked
        )
        if list(found) == picked:
            np.testing.assert_allclose(
                amounts[p, : len(found)], exact, atol=2e-3 * np.abs(exact).max(initial=0)
            )


def test_pursuit_picks_the_same_atoms():
    matrix, signals = problem(np.random.default_rng(0), 64, 400, 200)
    support, _ = fast_omp(matrix, signals, 10, 5.0)
    same = [
        list(support[p][support[p] >= 0])
        == plain_omp(matrix.astype(float), signals[p].astype(float), 10, 5.0)[0]
        for p in range(200)
    ]
    assert np.mean(same) > 0.99


def test_pursuit_stops_at_copies_and_at_nothing():
    matrix, signals = problem(np.random.default_rng(1), 16, 5, 3)
    matrix = np.ascontiguousarray(np.repeat(matrix, 4, axis=1))
    signals[2] = 0
    support, amounts = fast_omp(matrix, signals, 12, 0.0)
    assert (support[:2] >= 0).sum() == 10, "5 directions, however many copies"
    assert (support[2] == -1).all()
    assert not amounts[2].any()


@settings(deadline=None)  # the first call compiles
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 600), st.integers(0, 2**32 - 1))
def test_correlations_are_the_matrix_product(n, m, k, seed):
    rng = np.random.default_rng(seed)
    signals, matrix = (rng.standard_normal(s).astype(np.float32) for s in ((n, m), (m, k)))
    out = np.full((n, k), np.nan, np.float32)
    correlations(signals, matrix, out)
    np.testing.assert_allclose(out, signals.astype(np.float64) @ matrix, atol=1e-5)


def small_dictionary(rng, n_atoms=20, patch=4, slots=6):
    return Dictionary(unit(rng.standard_normal((n_atoms, patch, patch, slots)).astype(np.float32)))


def test_measurement_matrix_is_the_weighted_sum_over_slots():
    rng = np.random.default_rng(2)
    coder = PatchCoder.of(dictionary := small_dictionary(rng))
    weights = np.full((16, 6), 0.01, np.float32)
    weights[np.arange(16), rng.integers(0, 6, 16)] = 1.0
    matrix, lengths = np.empty((16, 20), np.float32), np.empty(20, np.float32)
    measurement_matrix(coder.by_pixel, coder.sums, weights, matrix, lengths)
    atoms = dictionary.atoms.reshape(20, 16, 6).astype(np.float64)
    np.testing.assert_allclose(matrix * lengths, np.einsum("kmt,mt->mk", atoms, weights), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=0), 1, rtol=1e-5)


@settings(deadline=None)  # the first call compiles
@given(st.integers(4, 21), st.integers(4, 40), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_painting_adds_every_patch_once(rows, cols, stride, seed):
    rng = np.random.default_rng(seed)
    dictionary = small_dictionary(rng)
    mask = rng.random((rows, cols)) < 0.1
    corners = patch_corners(mask, 4, stride)
    support = rng.integers(0, 20, (len(corners), 2))
    support[rng.random(support.shape) < 0.2] = -1
    amounts = rng.standard_normal(support.shape).astype(np.float32)
    total, count = PatchCoder.of(dictionary).paint(corners, support, amounts, (rows, cols))
    expected = np.zeros((rows, cols, 6))
    covered = np.zeros((rows, cols))
    for (v, u), atoms, factors in zip(corners, support, amounts, strict=True):
        covered[v : v + 4, u : u + 4] += 1
        for atom, factor in zip(atoms, factors, strict=True):
            if atom < 0:
                break
            expected[v : v + 4, u : u + 4] += factor * dictionary.atoms[atom]
    np.testing.assert_allclose(total, expected, atol=1e-4)
    np.testing.assert_array_equal(count, covered)
    assert count[mask].all() or stride > 4
    everywhere = overlap((rows, cols), 4, stride)
    assert (count <= everywhere).all()
    np.testing.assert_array_equal(count[mask], everywhere[mask])


def test_training_finds_the_atoms_that_made_the_clips():
    rng = np.random.default_rng(4)
    v, u = np.mgrid[:40, :40]
    clips = []
    for _ in range(12):
        angle, phase, speed = rng.uniform(0, 2 * np.pi, 3)
        wave = np.cos(angle) * v + np.sin(angle) * u
        clips.append(
            np.stack([1 + 0.5 * np.sin(wave + phase + 0.1 * speed * t) for t in range(8)]).astype(np.float32)
        )
    sizes = {"n_atoms": 40, "patch": 4, "slots": 6, "n_patches": 1200, "atoms_per_patch": 4}
    steps = []
    learned = train_dictionary(
        clips, rng=np.random.default_rng(0), iterations=5, progress=lambda *a: steps.append(a), **sizes
    )
    first = train_dictionary(clips, rng=np.random.default_rng(0), iterations=1, **sizes)
    again = train_dictionary(clips, rng=np.random.default_rng(0), iterations=5, **sizes)
    errors = [d.provenance["relative_rms_error"] for d in (first, learned)]
    assert errors[1] < 0.8 * errors[0], "the alternation improves on random patches"
    np.testing.assert_array_equal(learned.atoms, again.atoms)
    np.testing.assert_allclose(learned.atoms[0], learned.atoms[0, 0, 0, 0])
    assert steps[-1] == ("train", 5, 5)


def test_training_refuses_too_little():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueCheckError, match="at least"):
        train_dictionary([np.ones((4, 9, 9), np.float32)], rng=rng)
    with pytest.raises(ValueCheckError, match="usable patches"):
        train_dictionary([np.ones((36, 9, 9), np.float32)], rng=rng, n_patches=100)


def test_dictionary_file_keeps_atoms_to_8_bits(tmp_path):
    dictionary = small_dictionary(np.random.default_rng(0))
    path = tmp_path / "d.npz"
    save_dictionary(path, Dictionary(dictionary.atoms, {"seed": 7}))
    back = load_dictionary(path)
    assert back.provenance == {"seed": 7}
    # Rounding: half a step of peak / 127, then a new unit length.
    np.testing.assert_allclose(back.atoms, dictionary.atoms, atol=0.6 * np.abs(dictionary.atoms).max() / 127)
    with pytest.raises(StorageError, match="no such dictionary"):
        load_dictionary(tmp_path / "missing.npz")
    (tmp_path / "bad.npz").write_bytes(b"not a dictionary")
    with pytest.raises(StorageError, match="not a dictionary"):
        load_dictionary(tmp_path / "bad.npz")
    with pytest.raises(ValueCheckError, match="unit length"):
        Dictionary(2 * dictionary.atoms)
