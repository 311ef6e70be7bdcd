"""``optsim train``: make or import training footage, train a prior, write its small file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np

from optsim import __version__
from optsim.core.cache import Cache, default_folder, hash_of
from optsim.core.code_hash import hash_files
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import writable_folder
from optsim.core.folder_claims import claimed_file
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats, Timing, View
from optsim.footage.clips import ImportedClip
from optsim.priors.dictionary import save_dictionary
from optsim.priors.mixture import save_mixture
from optsim.priors.mixture_training import train_mixture
from optsim.priors.training import Method, train_dictionary
from optsim.scene import Scene

SCENE = "training_mix"
Prior = Literal["dictionary", "mixture"]
Footage = Literal["scene", "leaves", "both"]
# Small panels with the demo's field of view, so that speeds in pixels per slot are those at decoding.
_VIEW = View(rows=120, cols=160, samples_per_pitch=1, tan_half_width=0.32)
_TIMING = Timing(slot_s=1 / 180, slots_per_frame=36, n_frames=2)
_SAMPLES = 64
# Training footage of the shipped priors, chosen on moving photographs (benchmark reconstruct.photographs).
_SHIPPED: dict[Prior, Footage] = {"dictionary": "both", "mixture": "leaves"}
# Clips of dead leaves, and the batch that is drawn and stored together: the loss by a stop.
_LEAVES, _BATCH = 400, 25
_LEAF_CODE = ("optsim/scene/*.py",)
_RENDER_CODE = (*_LEAF_CODE, "optsim/render/*.py")


def training_textures() -> list[str]:
    """Names of the textures of the training scene."""
    from optsim import scene
    from optsim.scene.materials import Diffuse, Plastic

    materials = scene.load_scene(SCENE).materials.values()
    painted = [each for each in materials if isinstance(each, Diffuse | Plastic)]
    return [each.texture for each in painted if each.texture is not None]


def leaf_clips(*, seed: int, progress: Progress) -> list[Floats]:
    """Clips of dead leaves, (slot, v, u), with the textures of the training scene; cached."""
    from optsim.scene.dead_leaves import dead_leaves
    from optsim.scene.textures import reflectance_map

    cache = Cache()
    named = training_textures()
    textures = [reflectance_map(name) for name in named]
    clips: list[Floats] = []

    def one(number: int) -> Floats:
        return dead_leaves(textures, np.random.default_rng([seed, number]))

    for first in range(0, _LEAVES, _BATCH):
        progress("training footage", first, _LEAVES)

        def make(first: int = first) -> Mapping[str, Floats]:
            with ThreadPoolExecutor() as pool:
                return {"clips": np.stack(list(pool.map(one, range(first, first + _BATCH))))}

        key = hash_of("moving leaves", named, seed, first, _BATCH, hash_files(_LEAF_CODE))
        clips += list(np.array(cache.get(key, make)["clips"]))
    progress("training footage", _LEAVES, _LEAVES)
    return clips


def training_clips(*, seed: int, backend: str | None, progress: Progress) -> dict[str, Floats]:
    """Slot means, (slot, v, u), of every variation of the training scene; cached."""
    from optsim import render, scene

    cache = Cache()
    names = scene.list_scenes()[SCENE]
    clips: dict[str, Floats] = {}
    for done, name in enumerate(names):
        progress("rendered footage", done, len(names))
        chosen = scene.load_scene(SCENE, name)
        if chosen.reserved:
            raise ConfigError(
                f"scene {SCENE!r} is reserved for testing, so nothing may be trained on it; "
                "cure: train on another scene"
            )

        def make(chosen: Scene = chosen) -> dict[str, Floats]:
            return {
                "clip": render.render_footage(
                    chosen, _VIEW, _TIMING, samples=_SAMPLES, seed=seed, backend=backend, progress=progress
                )
            }

        key = hash_of(
            "training clip", chosen.model_dump(mode="json"), seed, _SAMPLES, hash_files(_RENDER_CODE)
        )
        clips[name] = np.array(cache.get(key, make)["clip"])
    progress("rendered footage", len(names), len(names))
    return clips


def train_prior(
    prior: Prior,
    out: Path | None,
    *,
    size: int | None = None,
    method: Method | None = None,
    seed: int = 1,
    footage: Footage | None = None,
    clips: Sequence[ImportedClip] = (),
    backend: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Train a prior on imported footage, the training scene, dead leaves or several of these.

    The state is cached after each iteration; the same call continues there.

    Parameters
    ----------
    prior : {"dictionary", "mixture"}
        Atoms for sparse coding, or Gaussians for the mixture decoder; of 8 x 8 pixels x 36 slots.
    out : Path, optional
        File to write; by default the shipped one, but not with imported clips.
    size : int, optional
        Atoms or Gaussians.
    method : {"mod", "ksvd"}, optional
        Update of a dictionary's atoms.
    seed : int
        Seed of footage, patches and the initial state.
    footage : {"scene", "leaves", "both"}, optional
        Renders of the training scene's variations, clips of :mod:`optsim.scene.dead_leaves`, or both; by
        default the footage of the shipped prior, and none of them beside imported clips.
    clips : sequence of ImportedClip
        The user's own footage.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Called after clips, rendered slots and iterations.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ConfigError
        When the file to write is no .npz, is missing where required, or a mixture is given a method.
    StorageError
        When the file cannot be written, a named one exists already, or another process trains it.
    """
    with claimed_file(prior_path(prior, out, method, imported=bool(clips))):
        # Again: another process may have written it since.
        path = prior_path(prior, out, method, imported=bool(clips))
        return _train(prior, path, size, method, seed, footage, clips, backend, progress)


def _train(
    prior: Prior,
    path: Path,
    size: int | None,
    method: Method | None,
    seed: int,
    footage: Footage | None,
    clips: Sequence[ImportedClip],
    backend: str | None,
    progress: Progress,
) -> Path:
    chosen = footage or (None if clips else _SHIPPED[prior])
    words = [
        *([] if size is None else [f"--size {size}"]),
        *([] if method is None else [f"--method {method}"]),
        f"--seed {seed}",
        *([] if chosen is None else [f"--footage {chosen}"]),
        *(f"--clips {clip.name}" for clip in clips),
    ]
    record: dict[str, Any] = {"command": " ".join(["optsim train", prior, *words]), "optsim": __version__}
    films: list[Floats] = []
    if clips:
        films += [clip.read(progress) for clip in clips]
        record["clips"] = [clip.record() for clip in clips]
    if chosen is not None:
        record["scene"] = SCENE
    if chosen in ("leaves", "both"):
        leaves = leaf_clips(seed=seed, progress=progress)
        films += leaves
        record["moving_leaves"] = len(leaves)
    if chosen in ("scene", "both"):
        rendered = training_clips(seed=seed, backend=backend, progress=progress)
        films += rendered.values()
        record |= {"variations": list(rendered), "samples": _SAMPLES}
    common: dict[str, Any] = {
        "rng": np.random.default_rng(seed),
        "provenance": record,
        "checkpoint": default_folder(),
        "progress": progress,
    }
    if prior == "dictionary":
        wanted: dict[str, Any] = {} if size is None else {"n_atoms": size}
        save_dictionary(path, train_dictionary(films, method=method or "mod", **wanted, **common))
    else:
        wanted = {} if size is None else {"n_components": size}
        save_mixture(path, train_mixture(films, **wanted, **common))
    return path


def prior_path(prior: Prior, out: Path | None, method: Method | None, *, imported: bool) -> Path:
    """File that a training will write; errors as in :func:`train_prior`."""
    if prior == "mixture" and method is not None:
        raise ConfigError(
            f"--method {method}: got it with a mixture, which learns by EM, expected it with a dictionary; "
            "cure: leave it out"
        )
    if out is None and imported:
        raise ConfigError(
            f"--out: missing; what is learned from --clips would replace the shipped {prior}; "
            f"cure: --out my_{prior}.npz"
        )
    path = out or Path(str(files("optsim.priors") / f"{prior}.npz"))
    if path.suffix != ".npz":
        raise ConfigError(f"--out {path}: expected a name that ends in .npz")
    if out is not None and path.exists():
        raise StorageError(f"--out {path} exists already; choose another name, or move it away")
    writable_folder(path.parent, "--out", "choose another one")
    return path
