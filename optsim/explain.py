"""What an experiment would be, before anything is rendered: geometry, photons, latency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, cast

from optsim.console import table

# Reflectance of a mid-grey card (the usual 18 % of photography), relative to the scene's declared white.
MID_GREY = 0.18


def explanation(name_or_path: str, assignments: Sequence[str]) -> dict[str, Any]:
    """Geometry, photon ledger and latency of an experiment, also of one whose geometry doesn't fit.

    Returns
    -------
    dict
        JSON-able; ``geometry.fits`` says whether it can be run.
    """
    from optsim.errors import GeometryError
    from optsim.experiment import load_experiment
    from optsim.truth import describe_truth

    try:
        experiment = load_experiment(name_or_path, assignments)
    except GeometryError:
        experiment = load_experiment(name_or_path, assignments, check_geometry=False)
    camera = experiment.camera
    truth = describe_truth(experiment)
    latency = camera.smallest_latency_frames()
    levels = {"mid-grey": MID_GREY * truth.white_w_m2_sr, "white": truth.white_w_m2_sr}
    return {
        "experiment": experiment.name,
        "truth": f"{truth.name} ({truth.variation}): {truth.description}",
        "geometry": {**asdict(camera.geometry()), "fits": camera.geometry().fits},
        "latency": {
            **asdict(latency),
            "chosen_frames": camera.latency_frames,
            "hypothetical": camera.latency_frames < latency.frames,
        },
        "ledger": {
            name: {"radiance_w_m2_sr": level, "rows": [asdict(row) for row in camera.ledger(level)]}
            for name, level in levels.items()
        },
    }


def show(record: dict[str, Any]) -> list[object]:
    """Turn an explanation into tables for a terminal."""
    geometry = cast("dict[str, Any]", record["geometry"])
    latency = cast("dict[str, Any]", record["latency"])
    items: list[object] = [
        record["truth"],
        table("geometry", ("quantity", "value"), [(k, v) for k, v in geometry.items()]),
        table("latency", ("quantity", "value"), [(k, v) for k, v in latency.items()]),
    ]
    if latency["hypothetical"]:
        items.append(
            f"latency of {latency['chosen_frames']} is hypothetical: the smallest physical one is "
            f"{latency['frames']} frames"
        )
    for name, ledger in cast("dict[str, dict[str, Any]]", record["ledger"]).items():
        rows = cast("list[dict[str, Any]]", ledger["rows"])
        items.append(
            table(
                f"photon ledger, {name} ({ledger['radiance_w_m2_sr']:.4g} W m^-2 sr^-1), all-on, no density",
                tuple(rows[0]),
                [tuple(row.values()) for row in rows],
            )
        )
    if not geometry["fits"]:
        items.append("the geometry does not fit: this experiment cannot be run")
    return items
