"""Learning priors: both updates of atoms, and that going on after a stop is the same as not stopping."""

import numpy as np
import pytest

from optsim.core.errors import ValueCheckError
from optsim.priors import iterations
from optsim.priors.atom_updates import dense, k_svd_atoms
from optsim.priors.dictionary import unit
from optsim.priors.mixture_training import train_mixture
from optsim.priors.training import learn_atoms, train_dictionary


def planted(rng, n_atoms=30, size=24, n=1500, cap=3, noise=0.05):
    """Random atoms, the first of them constant, and signals of three of them each."""
    atoms = unit(np.concatenate([np.ones((1, size)), rng.standard_normal((n_atoms - 1, size))]))
    support = np.stack([rng.choice(n_atoms, cap, replace=False) for _ in range(n)])
    amounts = (rng.uniform(0.5, 1.5, (n, cap)) * rng.choice((-1, 1), (n, cap))).astype(np.float32)
    signals = dense(support, amounts, n_atoms) @ atoms
    signals += noise * rng.standard_normal(signals.shape).astype(np.float32)
    return atoms, support, amounts, signals.astype(np.float32)


# --- approximate K-SVD ----------------------------------------------------------------------------------


def test_k_svd_lowers_the_error_pass_by_pass_for_fixed_supports():
    rng = np.random.default_rng(0)
    _, support, amounts, signals = planted(rng)
    support[::7, 2] = -1
    atoms = unit(np.concatenate([np.ones((1, 24)), rng.standard_normal((29, 24))]))
    constant = atoms[0].copy()
    errors = [np.linalg.norm(signals - dense(support, amounts, 30) @ atoms)]
    for _ in range(6):
        atoms, amounts = k_svd_atoms(signals, atoms, support, amounts)
        errors.append(np.linalg.norm(signals - dense(support, amounts, 30) @ atoms))
    assert (np.diff(errors) < 0).all(), errors
    assert errors[-1] < 0.5 * errors[0]
    np.testing.assert_array_equal(atoms[0], constant)
    np.testing.assert_allclose(np.linalg.norm(atoms, axis=1), 1, rtol=1e-5)


def test_k_svd_is_the_papers_step_atom_by_atom():
    """Against its equations with whole arrays in double precision, one atom after the other."""
    rng = np.random.default_rng(1)
    atoms, support, amounts, signals = planted(rng, n_atoms=8, n=60)
    atoms = unit(np.concatenate([atoms[:1], atoms[1:] + 0.2 * rng.standard_normal(atoms[1:].shape)]))
    found, coefficients = k_svd_atoms(signals, atoms, support, amounts)
    d, codes = atoms.astype(np.float64), dense(support, amounts, 8).astype(np.float64)
    for k in range(1, 8):
        users = codes[:, k] != 0
        others = codes[users].copy()
        others[:, k] = 0
        left = signals[users] - others @ d
        d[k] = left.T @ codes[users, k]
        d[k] /= np.linalg.norm(d[k])
        codes[users, k] = left @ d[k]
    np.testing.assert_allclose(found, d, atol=2e-5)
    np.testing.assert_allclose(dense(support, coefficients, 8), codes, atol=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["mod", "ksvd"])
def test_planted_atoms_are_found_again(method):
    """Of 29 random atoms, signals with 5 % of noise: on average over eight seeds 23 within 8 degrees.

    Measured 24.9 by least squares and 25.6 by K-SVD, each seed 20 to 29: where learning begins with signals,
    some atoms end as mixtures of two. Before learning it is none.
    """
    before, after = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        atoms, _, _, signals = planted(rng)
        first = unit(np.concatenate([atoms[:1], signals[rng.choice(len(signals), 29, replace=False)]]))
        found, _ = learn_atoms(signals, first, 3, 30, method)
        for counts, these in ((before, first), (after, found)):
            near = np.abs(atoms[1:] @ these.T).max(axis=1) > np.cos(np.deg2rad(8))
            counts.append(int(near.sum()))
    assert np.mean(after) >= 23, after
    assert min(after) >= 17, after
    assert max(before) <= 2, before


# --- stops ----------------------------------------------------------------------------------------------

CLIPS = [np.random.default_rng(9).random((40, 40, 40), dtype=np.float32) ** 3]
LEARN = {
    "mod": (train_dictionary, {"n_atoms": 20, "patch": 4, "slots": 6, "n_patches": 300, "method": "mod"}),
    "ksvd": (train_dictionary, {"n_atoms": 20, "patch": 4, "slots": 6, "n_patches": 300, "method": "ksvd"}),
    "mixture": (train_mixture, {"n_components": 3, "rank": 24, "patch": 4, "slots": 6, "n_patches": 900}),
}


class Stop(Exception):
    """Stands for Ctrl-C."""


def learn(prior, checkpoint, stop_after=None, seed=0, **changed):
    """Learn for five iterations; return what was learned and the iterations told of."""
    train, settings = LEARN[prior]
    told = []

    def progress(stage, done, total):
        told.append(done)
        if done == stop_after:
            raise Stop

    try:
        settings = settings | {"iterations": 5} | changed
        rng = np.random.default_rng(seed)
        return train(CLIPS, rng=rng, checkpoint=checkpoint, progress=progress, **settings), told
    except Stop:
        return None, told


def arrays(learned):
    return {name: value for name, value in vars(learned).items() if name != "provenance"}


def assert_same(one, other):
    assert one.provenance == other.provenance
    for name, value in arrays(one).items():
        np.testing.assert_array_equal(value, arrays(other)[name], err_msg=name)


@pytest.mark.parametrize("prior", LEARN)
@pytest.mark.parametrize("stop_after", [1, 3, 5])
def test_going_on_is_the_same_to_the_bit_as_not_stopping(prior, stop_after, tmp_path):
    whole, steps = learn(prior, None)
    assert steps == [0, 1, 2, 3, 4, 5]
    assert learn(prior, tmp_path, stop_after)[0] is None
    again, steps = learn(prior, tmp_path)
    assert steps == list(range(stop_after, 6)), "it goes on, rather than to begin again"
    assert_same(whole, again)


@pytest.mark.parametrize("prior", LEARN)
@pytest.mark.parametrize(
    "changed",
    [{"seed": 1}, {"iterations": 4}, {"n_patches": 910}, "size", "method", "footage", "code", "damaged"],
)
def test_other_settings_footage_code_or_damaged_states_begin_again(prior, changed, tmp_path, monkeypatch):
    learn(prior, tmp_path, 3)
    if changed == "size":
        changed = {"n_components": 4} if prior == "mixture" else {"n_atoms": 21}
    elif changed == "method":
        changed = {"rank": 20} if prior == "mixture" else {"method": "ksvd" if prior == "mod" else "mod"}
    elif changed == "footage":
        monkeypatch.setitem(globals(), "CLIPS", [CLIPS[0] ** 1.1])
        changed = {}
    elif changed == "code":
        monkeypatch.setattr(iterations, "hash_files", lambda _: "of another code")
        changed = {}
    elif changed == "damaged":
        for path in tmp_path.rglob("*.npy"):
            path.write_bytes(path.read_bytes()[:100])
        changed = {}
    found, steps = learn(prior, tmp_path, **changed)
    assert steps[0] == 0
    assert_same(found, learn(prior, None, **changed)[0])


@pytest.mark.parametrize("prior", LEARN)
@pytest.mark.parametrize("clip", [np.full((40, 40, 40), 0.3), np.tile(CLIPS[0][:1], (40, 1, 1))])
def test_footage_in_which_nothing_moves_teaches_nothing(prior, clip, monkeypatch):
    monkeypatch.setitem(globals(), "CLIPS", [clip.astype(np.float32)])
    with pytest.raises(ValueCheckError, match=r"nothing in them changes from slot to slot.*cure: other"):
        learn(prior, None)


def test_a_mixture_of_few_patterns_is_a_mixture(monkeypatch):
    """Two stripes that drift alike fill three dimensions, of the 24 that are asked for."""
    stripes = 1 + 0.5 * np.sin(np.arange(40)[:, None, None] * 0.7 + np.arange(40) * np.pi / 2)
    monkeypatch.setitem(globals(), "CLIPS", [np.broadcast_to(stripes, (40, 40, 40)).astype(np.float32)])
    found = learn("mixture", None)[0]
    assert all(np.isfinite(value).all() for value in arrays(found).values())
    assert (np.linalg.eigvalsh(found.covariances) > 0).all()
