"""``optsim train``: make training footage, learn a prior, write the small file that ships."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np

from optsim import __version__
from optsim.cache import Cache, hash_of
from optsim.errors import ConfigError
from optsim.progress import Progress, silent
from optsim.quantities import Floats, Timing, View
from optsim.reconstruct.dictionary import save_dictionary
from optsim.reconstruct.mixture import save_mixture
from optsim.reconstruct.mixture_training import train_mixture
from optsim.reconstruct.training import train_dictionary
from optsim.scene import Scene

SCENE = "training_mix"
Prior = Literal["dictionary", "mixture"]
Footage = Literal["scene", "leaves", "both"]
# Small panels with the demo's field of view: speeds in pixels per slot are those that decoders will meet.
_VIEW = View(rows=120, cols=160, samples_per_pitch=1, tan_half_width=0.32)
_TIMING = Timing(slot_s=1 / 180, slots_per_frame=36, n_frames=2)
_SAMPLES = 64
# What the shipped priors learned from, chosen on moving photographs (benchmark reconstruct.photographs).
_SHIPPED: dict[Prior, Footage] = {"dictionary": "both", "mixture": "leaves"}
# Clips of moving leaves, and how many are drawn and kept at a time: what a stop loses.
_LEAVES, _BATCH = 400, 25


def training_textures() -> list[str]:
    """Names of the textures of the training scene."""
    from optsim import scene
    from optsim.scene.materials import Diffuse, Plastic

    materials = scene.load_scene(SCENE).materials.values()
    painted = [each for each in materials if isinstance(each, Diffuse | Plastic)]
    return [each.texture for each in painted if each.texture is not None]


def leaf_clips(*, seed: int, progress: Progress) -> list[Floats]:
    """Clips of leaves, (slot, v, u), that carry the textures of the training scene; cached."""
    from optsim.scene.moving_leaves import moving_leaves
    from optsim.scene.textures import reflectance_map

    cache = Cache()
    named = training_textures()
    textures = [reflectance_map(name) for name in named]
    clips: list[Floats] = []

    def one(number: int) -> Floats:
        return moving_leaves(textures, np.random.default_rng([seed, number]))

    for first in range(0, _LEAVES, _BATCH):
        progress("training footage", first, _LEAVES)

        def make(first: int = first) -> Mapping[str, Floats]:
            with ThreadPoolExecutor() as pool:
                return {"clips": np.stack(list(pool.map(one, range(first, first + _BATCH))))}

        key = hash_of("moving leaves", named, seed, first, _BATCH, __version__)
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

        key = hash_of("training clip", chosen.model_dump(mode="json"), seed, _SAMPLES, __version__)
        clips[name] = np.array(cache.get(key, make)["clip"])
    progress("rendered footage", len(names), len(names))
    return clips


def train_shipped(
    prior: Prior,
    out: Path | None,
    *,
    size: int | None = None,
    seed: int = 1,
    footage: Footage | None = None,
    backend: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Learn a prior from the training scene, moving leaves with its textures or both, and write it.

    Parameters
    ----------
    prior : {"dictionary", "mixture"}
        Atoms for sparse coding, or Gaussians for the mixture decoder; of 8 x 8 pixels x 36 slots.
    out : Path, optional
        File to write; by default the one that the package ships.
    size : int, optional
        Atoms or Gaussians.
    seed : int
        Of footage, patches and where learning begins.
    footage : {"scene", "leaves", "both"}
        Renders of the training scene's variations, clips of :mod:`optsim.scene.moving_leaves`, or both; by
        default what the shipped prior learned from.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Told of clips, of slots rendered and of iterations.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ConfigError
        When the file to write is no .npz.
    """
    path = out or Path(str(files("optsim.reconstruct") / f"{prior}.npz"))
    if path.suffix != ".npz":
        raise ConfigError(f"--out {path}: expected a name that ends in .npz")
    footage = footage or _SHIPPED[prior]
    sized = "" if size is None else f" --size {size}"
    record: dict[str, Any] = {
        "command": f"optsim train {prior}{sized} --seed {seed} --footage {footage}",
        "scene": SCENE,
        "optsim": __version__,
    }
    clips: list[Floats] = []
    if footage != "scene":
        clips += leaf_clips(seed=seed, progress=progress)
        record["moving_leaves"] = len(clips)
    if footage != "leaves":
        rendered = training_clips(seed=seed, backend=backend, progress=progress)
        clips += rendered.values()
        record |= {"variations": list(rendered), "samples": _SAMPLES}
    common: dict[str, Any] = {
        "rng": np.random.default_rng(seed),
        "provenance": record,
        "progress": progress,
    }
    if prior == "dictionary":
        wanted = {} if size is None else {"n_atoms": size}
        save_dictionary(path, train_dictionary(clips, **wanted, **common))
    else:
        wanted = {} if size is None else {"n_components": size}
        save_mixture(path, train_mixture(clips, **wanted, **common))
    return path
