"""Matching pursuit against a plain one; measurement matrices and overlap sums against their definitions."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from optsim.core.errors import StorageError, ValueCheckError
from optsim.decoding.patch_grid import overlap, patch_corners
from optsim.decoding.sparse.matching_pursuit import pursue
from optsim.decoding.sparse.patch_codes import PatchCoder, measurement_matrix
from optsim.decoding.sparse.rounded_steps import follow, look, make_steps
from optsim.priors.correlation_bounds import PANEL, correlate, pack, packed_shape, peaks_of
from optsim.priors.dictionary import Dictionary, load_dictionary, save_dictionary, unit
from optsim.priors.gram_pursuit import pursue_products
from optsim.priors.training import train_dictionary


def plain_omp(matrix, signal, cap, stop, *, recursive=True):
    """Pick the best atom, fit all picked by least squares, repeat; float64.

    The best leaves the least residual (``recursive``), or has the greatest correlation. One that takes
    less than 1e-12 of the signal's energy is rounding of its float32 numbers, and not picked.
    """
    picked, amounts, left = [], np.zeros(0), signal
    basis = np.zeros((len(signal), 0))
    while len(picked) < cap and left @ left > stop:
        rest = matrix - basis @ (basis.T @ matrix)
        distance = (rest**2).sum(axis=0) if recursive else np.ones(matrix.shape[1])
        score = np.where(distance > 1e-5, (matrix.T @ left) ** 2 / np.maximum(distance, 1e-12), 0)
        if recursive and score.max() <= 1e-12 * (signal @ signal):
            break
        picked.append(int(np.argmax(score)))
        basis = np.linalg.qr(matrix[:, picked])[0]
        amounts = np.linalg.lstsq(matrix[:, picked], signal, rcond=None)[0]
        left = signal - matrix[:, picked] @ amounts
    return picked, amounts, left


def fast_omp(matrix, signals, cap, stop):
    support = np.empty((len(signals), cap), np.int64)
    amounts = np.empty((len(signals), cap), np.float32)
    pursue(matrix, signals, np.broadcast_to(np.float32(stop), len(signals)).copy(), support, amounts)
    return support, amounts


def problem(rng, m, k, n):
    matrix = rng.standard_normal((m, k)).astype(np.float32)
    return matrix / np.linalg.norm(matrix, axis=0), rng.standard_normal((n, m)).astype(np.float32)


@settings(deadline=None)  # the first call compiles
@given(
    st.integers(3, 40), st.integers(2, 300), st.integers(1, 40), st.integers(1, 12), st.integers(0, 2**32 - 1)
)
@example(32, 7, 14, 7, 148270842)  # its last atom would take 6e-13 of the energy
def test_pursuit_equals_plain_pursuit(m, k, n, cap, seed):
    cap = min(cap, m - 1, k)
    matrix, signals = problem(np.random.default_rng(seed), m, k, n)
    support, amounts = fast_omp(matrix, signals, cap, 0.3)
    for p in range(n):
        picked, exact, left = plain_omp(matrix.astype(np.float64), signals[p].astype(np.float64), cap, 0.3)
        found = support[p][support[p] >= 0]
        rest = signals[p] - matrix[:, found].astype(np.float64) @ amounts[p, : len(found)]
        assert list(found) == picked
        assert abs(np.linalg.norm(rest) - np.linalg.norm(left)) < 1e-5 * np.linalg.norm(signals[p])
        np.testing.assert_allclose(
            amounts[p, : len(found)], exact, atol=1e-4 * np.abs(exact).max(initial=1e-30)
        )


@pytest.mark.parametrize("m", [64, 57])
def test_pursuit_picks_the_same_atoms_of_a_coherent_dictionary(m):
    """Neighbouring atoms are nearly alike, and many are picked, down to a small residual."""
    rng = np.random.default_rng(0)
    matrix, _ = problem(rng, m, 700, 1)
    matrix = np.cumsum(matrix, axis=0) + np.roll(matrix, 1, axis=1)
    matrix = (matrix / np.linalg.norm(matrix, axis=0)).astype(np.float32)
    codes = rng.standard_normal((700, 12)) * (rng.random((700, 12)) < 0.03)
    signals = (matrix @ codes + 1e-3 * rng.standard_normal((m, 12))).T.astype(np.float32)
    support, _ = fast_omp(matrix, signals, 30, 0.0)
    for p in range(12):
        picked, _, _ = plain_omp(matrix.astype(np.float64), signals[p].astype(np.float64), 30, 0.0)
        np.testing.assert_array_equal(support[p], picked)


def test_each_signal_has_its_own_stop():
    matrix, signals = problem(np.random.default_rng(0), 64, 400, 200)
    stop = np.random.default_rng(1).uniform(0, 70, 200)
    support, _ = fast_omp(matrix, signals, 10, stop)
    for p in range(200):
        picked, _, _ = plain_omp(matrix.astype(float), signals[p].astype(float), 10, np.float32(stop[p]))
        assert list(support[p][support[p] >= 0]) == picked
    lengths = (support >= 0).sum(axis=1)
    assert lengths.min() == 0
    assert lengths.max() == 10


def test_codes_do_not_depend_on_the_company():
    matrix, signals = problem(np.random.default_rng(5), 64, 333, 101)
    stop = np.linspace(0, 60, 101)
    whole = fast_omp(matrix, signals, 12, stop)
    for size in (1, 3, 7, 64):
        parts = [
            fast_omp(matrix, signals[first : first + size], 12, stop[first : first + size])
            for first in range(0, 101, size)
        ]
        for all_of_them, found in zip(whole, zip(*parts, strict=True), strict=True):
            np.testing.assert_array_equal(all_of_them, np.concatenate(found))
    order = np.random.default_rng(6).permutation(101)
    for all_of_them, found in zip(whole, fast_omp(matrix, signals[order], 12, stop[order]), strict=True):
        np.testing.assert_array_equal(all_of_them[order], found)


@pytest.mark.parametrize("size", [1e-30, 1e-3, 1e12])
def test_pursuit_has_no_scale(size):
    matrix, signals = problem(np.random.default_rng(7), 30, 100, 20)
    factor = np.float32(2.0 ** np.round(np.log2(size)))
    support, amounts = fast_omp(matrix, signals, 8, 0.0)
    scaled, larger = fast_omp(matrix, signals * factor, 8, 0.0)
    np.testing.assert_array_equal(support, scaled)
    np.testing.assert_array_equal(amounts * factor, larger)


def test_first_of_equal_atoms_and_no_zero_ones():
    matrix, signals = problem(np.random.default_rng(8), 32, 50, 30)
    single, _ = fast_omp(matrix, signals, 10, 0.0)
    doubled = np.zeros((32, 150), np.float32)
    doubled[:, 20:70] = doubled[:, 100:150] = matrix
    support, _ = fast_omp(doubled, signals, 10, 0.0)
    np.testing.assert_array_equal(support, single + 20)


def test_pursuit_stops_where_the_span_ends():
    """Rank 6 of 20 dimensions: signals beyond the span end after 6 atoms, those inside at no residual."""
    rng = np.random.default_rng(9)
    matrix = rng.standard_normal((20, 6)) @ rng.standard_normal((6, 90))
    matrix = (matrix / np.linalg.norm(matrix, axis=0)).astype(np.float32)
    signals = rng.standard_normal((30, 20)).astype(np.float32)
    inside = (matrix @ rng.standard_normal((90, 30))).T.astype(np.float32)
    for given_signals in (signals, inside):
        support, amounts = fast_omp(matrix, given_signals, 15, 0.0)
        assert ((support >= 0).sum(axis=1) == 6).all()
        assert np.isfinite(amounts).all()
        best = matrix @ np.linalg.lstsq(matrix, given_signals.T, rcond=1e-5)[0]
        for p in range(30):
            found = matrix[:, support[p, :6]] @ amounts[p, :6]
            np.testing.assert_allclose(found, best[:, p], atol=1e-4 * np.linalg.norm(best[:, p]))
    one = signals[0] / np.linalg.norm(signals[0])
    support, amounts = fast_omp(one[:, None], (3 * one)[None], 4, 0.0)
    np.testing.assert_array_equal(support, [[0, -1, -1, -1]])
    np.testing.assert_allclose(amounts, [[3, 0, 0, 0]], rtol=1e-6)


def test_pursuit_stops_at_copies_and_at_nothing():
    matrix, signals = problem(np.random.default_rng(1), 16, 5, 3)
    matrix = np.ascontiguousarray(np.repeat(matrix, 4, axis=1))
    signals[2] = 0
    support, amounts = fast_omp(matrix, signals, 12, 0.0)
    assert (support[:2] >= 0).sum() == 10, "5 directions, however many copies"
    assert (support[2] == -1).all()
    assert not amounts[2].any()


@settings(deadline=None)  # the first call compiles
@given(st.integers(1, 90), st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_rounded_matrix_is_off_by_no_more_than_said(m, k, seed):
    rng = np.random.default_rng(seed)
    matrix, _ = problem(rng, m, k, 1)
    matrix[:, rng.random(k) < 0.1] = 0
    packed = np.full(packed_shape(m, k), -7, np.int16)
    step, error = pack(matrix, packed)
    rounded = step * packed.transpose(1, 3, 0, 2).reshape(-1, packed.shape[0] * PANEL)
    assert not rounded[m:].any()
    assert not rounded[:, k:].any()
    off = np.linalg.norm(rounded[:m, :k] - matrix, axis=0)
    assert abs(off.max() - error) < 1e-6
    assert error < 1.5e-5 * (np.sqrt(m) + 1)


def worst_errors(m, k, slots, n_steps, seed):
    """Errors of correlations and distances in units of their bounds, (look, each step, another look; 2)."""
    rng = np.random.default_rng(seed)
    matrix, vectors = problem(rng, m, k, slots)
    packed = np.empty(packed_shape(m, k), np.int16)
    grid = pack(matrix, packed)
    steps = make_steps(slots, m, packed.shape[1])
    state = np.zeros((packed.shape[0], slots, 2, PANEL), np.float32)
    state[:, :, 1] = 1
    peaks = np.full((slots, peaks_of(packed.shape[0])), np.nan, np.float32)
    residual, far = vectors.astype(np.float64), np.ones((slots, k))
    directions = np.stack([np.linalg.qr(rng.standard_normal((m, m)))[0].T for _ in range(slots)])
    worst = np.zeros((2 + n_steps, 2))
    for count in range(2 + n_steps):
        for slot in range(slots):
            if count in {0, 1 + n_steps}:
                state[:, slot, 0] = 0
                look(slot, residual, np.linalg.norm(residual[slot]), grid, steps)
                continue
            direction = directions[slot, count - 1]
            share = residual[slot] @ direction
            residual[slot] -= share * direction
            far[slot] -= (direction @ matrix) ** 2
            which, left = slot * m + count - 1, np.linalg.norm(residual[slot])
            follow(slot, directions.reshape(-1, m), which, share, left, count, grid, steps)
        correlate(packed, steps.moves, state, steps.terms, peaks, slots)
        found, distance = state.transpose(1, 2, 0, 3).reshape(slots, 2, -1)[:, :, :k].transpose(1, 0, 2)
        exact = residual @ matrix.astype(np.float64)
        c_error, n_error = steps.terms[:, 2:3], steps.terms[:, 3:]
        worst[count, 0] = (np.abs(found - exact) / c_error).max()
        worst[count, 1] = (np.abs(distance - far) / np.maximum(n_error, 1e-6)).max()
        most = (np.abs(found) + c_error) ** 2 / np.maximum(distance - n_error, 1e-5)
        np.testing.assert_allclose(peaks.max(axis=1), most.max(axis=1), rtol=1e-5)
    return worst


@settings(deadline=None)  # the first call compiles
@given(
    st.integers(1, 90), st.integers(1, 300), st.integers(1, 9), st.integers(0, 12), st.integers(0, 2**32 - 1)
)
def test_correlations_stay_within_their_bounds(m, k, slots, n_steps, seed):
    assert worst_errors(m, k, slots, min(n_steps, m - 1), seed).max() <= 1


def test_bounds_are_not_far_from_the_errors():
    """Of many atoms in two or three dimensions one comes near its bounds, at every step."""
    for m, least in ((2, (0.78, 0.65)), (3, (0.72, 0.55))):
        worst = np.median([worst_errors(m, 2000, 1, m - 1, seed) for seed in range(60)], axis=0)
        assert (worst[1:] > least).all(), (m, worst)


def test_pursuit_from_products_picks_by_correlation():
    matrix, signals = problem(np.random.default_rng(3), 40, 90, 50)
    support = np.empty((50, 8), np.int64)
    amounts = np.empty((50, 8), np.float32)
    pursue_products(signals @ matrix, matrix.T @ matrix, support, amounts)
    for p in range(50):
        picked, exact, _ = plain_omp(matrix.astype(float), signals[p].astype(float), 8, 0.0, recursive=False)
        np.testing.assert_array_equal(support[p], picked)
        np.testing.assert_allclose(amounts[p], exact, atol=1e-4 * np.abs(exact).max())


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
    measured = np.einsum("kmt,mt->mk", atoms, weights)
    long = np.linalg.norm(measured, axis=0)
    used = long >= 0.6 * np.median(long)
    assert used.sum() > 10
    np.testing.assert_allclose((matrix * lengths)[:, used], measured[:, used], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=0), used, rtol=1e-5)


def test_atoms_that_the_code_hardly_measures_are_left_out():
    """0.6 of what the median atom has in open slots is enough."""
    atoms = np.zeros((5, 4, 4, 6), np.float32)
    open_share = np.array([1, 1, 1, 0.65, 0.55])
    atoms[:, :, :, 0], atoms[:, :, :, 1] = (
        share[:, None, None] / 4 for share in (open_share, np.sqrt(1 - open_share**2))
    )
    coder = PatchCoder.of(Dictionary(atoms))
    weights = np.zeros((16, 6), np.float32)
    weights[:, 0] = 1
    matrix, lengths = np.empty((16, 5), np.float32), np.empty(5, np.float32)
    measurement_matrix(coder.by_pixel, coder.sums, weights, matrix, lengths)
    np.testing.assert_allclose(lengths, [1, 1, 1, 0.65, np.inf], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(matrix, axis=0), [1, 1, 1, 1, 0], rtol=1e-6)
    measurement_matrix(coder.by_pixel, coder.sums, np.zeros_like(weights), matrix, lengths)
    assert np.isinf(lengths).all()
    assert (matrix == 0).all()


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
        train_dictionary([rng.random((36, 9, 9), np.float32)], rng=rng, n_patches=100)


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
