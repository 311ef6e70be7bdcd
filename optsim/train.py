"""``optsim train``: render training footage, learn the dictionary, write the small file that ships."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np

from optsim import __version__
from optsim.cache import Cache, hash_of
from optsim.errors import ConfigError
from optsim.progress import Progress, silent
from optsim.quantities import Floats, Timing, View
from optsim.reconstruct.dictionary import save_dictionary
from optsim.reconstruct.training import train_dictionary
from optsim.scene import Scene

SCENE = "training_mix"
SHIPPED = Path(str(files("optsim.reconstruct") / "dictionary.npz"))
# Small panels with the demo's field of view: speeds in pixels per slot are those that decoders will meet.
_VIEW = View(rows=120, cols=160, samples_per_pitch=1, tan_half_width=0.32)
_TIMING = Timing(slot_s=1 / 180, slots_per_frame=36, n_frames=2)
_SAMPLES = 64


def training_clips(*, seed: int, backend: str | None, progress: Progress) -> dict[str, Floats]:
    """Slot means, (slot, v, u), of every variation of the training scene; cached."""
    from optsim import render, scene

    cache = Cache()
    names = scene.list_scenes()[SCENE]
    clips: dict[str, Floats] = {}
    for done, name in enumerate(names):
        progress("training footage", done, len(names))
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
    progress("training footage", len(names), len(names))
    return clips


def train_shipped(
    out: Path | None,
    *,
    n_atoms: int = 1000,
    seed: int = 1,
    backend: str | None = None,
    progress: Progress = silent,
) -> Path:
    """Learn a dictionary from the training scene and write it.

    Parameters
    ----------
    out : Path, optional
        File to write; by default the one that the package ships.
    n_atoms : int
        Atoms of 8 x 8 pixels x 36 slots.
    seed : int
        Of renders, patches and first atoms.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Told of slots rendered and of alternations.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ConfigError
        When the file to write is no .npz.
    """
    path = out or SHIPPED
    if path.suffix != ".npz":
        raise ConfigError(f"--out {path}: expected a name that ends in .npz")
    clips = training_clips(seed=seed, backend=backend, progress=progress)
    dictionary = train_dictionary(
        list(clips.values()),
        rng=np.random.default_rng(seed),
        n_atoms=n_atoms,
        provenance={
            "command": f"optsim train --atoms {n_atoms} --seed {seed}",
            "scene": SCENE,
            "variations": list(clips),
            "samples": _SAMPLES,
            "optsim": __version__,
        },
        progress=progress,
    )
    save_dictionary(path, dictionary)
    return path
