"""What is shipped, one line each: scenes, presets, schemes, decoders, metrics, effects, parts, objects."""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

from optsim.core.config import Part, read_toml
from optsim.core.extensions import DECODERS, OBJECTS, PARTS, SCHEMES, kind_of, offered


def catalogue(what: str) -> list[tuple[str, str]]:
    """Names and first lines of a kind of shipped thing."""
    if what == "presets":
        from optsim.experiment.experiment import experiment_path, preset_names

        return [(n, str(read_toml(experiment_path(n)).get("description", ""))) for n in preset_names()]
    if what == "scenes":
        from optsim import scene

        return [(name, scene.load_scene(name).description) for name in scene.list_scenes()]
    if what == "metrics":
        from optsim import metrics

        return [(metric.name, _first_line(type(metric))) for metric in metrics.every_metric()]
    if what == "effects":
        from optsim.camera import effects

        return [(name, effect.what) for name, effect in effects.ALL.items()]
    if what == "schemes":
        from optsim import coding

        return _lines((*coding.ALL, *offered(SCHEMES).values()))
    if what == "objects":
        from optsim.scene.scene import Mover, StillObject

        own = (each for union in (StillObject, Mover) for each in get_args(get_args(union)[0]))
        return _lines((*own, *offered(OBJECTS).values()))
    if what == "parts":
        from optsim.camera import parts

        own = {
            "objective": parts.Objective,
            "splitter": parts.Splitter,
            "modulator": parts.Modulator,
            "relay": parts.Relay,
            "sensor": parts.Ccd,
        }
        return [(name, _first_line(each)) for name, each in own.items()] + _lines(offered(PARTS).values())
    from optsim import decoding as reconstruct

    return _lines((*reconstruct.ALL, *offered(DECODERS).values()))


def _lines(parts: Iterable[type[Part]]) -> list[tuple[str, str]]:
    return [(kind_of(part), _first_line(part)) for part in parts]


def _first_line(thing: type) -> str:
    return (thing.__doc__ or "").strip().splitlines()[0]
