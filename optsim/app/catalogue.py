"""What is shipped, one line each: scenes, presets, schemes, decoders, metrics, effects."""

from __future__ import annotations

from optsim.core.config import Part, read_toml


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

        return [(metric.name, _first_line(type(metric))) for metric in metrics.ALL]
    if what == "effects":
        from optsim.camera import effects

        return [(name, effect.what) for name, effect in effects.ALL.items()]
    if what == "schemes":
        from optsim import coding

        return [(_kind(part), _first_line(part)) for part in coding.ALL]
    from optsim import decoding as reconstruct

    return [(_kind(part), _first_line(part)) for part in reconstruct.ALL]


def _kind(part: type[Part]) -> str:
    return str(part.model_fields["kind"].default)


def _first_line(thing: type) -> str:
    return (thing.__doc__ or "").strip().splitlines()[0]
