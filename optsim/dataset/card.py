"""Documents of a data set: card, manifest, Croissant metadata, README."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.files import content_hash
from optsim.dataset.arrays import PASSES
from optsim.dataset.channels import CONVENTIONS
from optsim.dataset.reading import KIND, MANIFEST
from optsim.dataset.spec import SPLITS, DatasetSpec, SequencePlan, remarks
from optsim.experiment.run_folder import versions

Record = dict[str, Any]
_CHECKS = {
    "flow_error_px": ("flow against depth and poses, largest difference, fine samples", max),
    "id_agreement": ("ids after following the flow, least share that agrees", min),
    "negative_share": ("negative radiance (unbiased noise), largest share of samples", max),
    "noise_share": ("noise of the truth, largest median of sigma over radiance", max),
    "noise_rms": (
        "noise of the truth, rms of sigma over (radiance + 1 % of white), median of the slots",
        max,
    ),
}


def card(
    spec: DatasetSpec,
    sequences: Sequence[SequencePlan],
    checks: Mapping[str, Record],
    layout: str,
    manifest_sha256: str,
    *,
    recipe: bool,
    filters: Sequence[Record],
) -> Record:
    """Content of ``dataset.json``; sequences and checks are those that filters keep."""
    cameras = {name: _camera(spec, name) for name in spec.cameras}
    return {
        "kind": KIND,
        "name": spec.name,
        "description": spec.description,
        "licence": spec.licence,
        "made_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "layout": layout,
        "recipe": recipe,
        "spec": spec.model_dump(mode="json"),
        "manifest": {"file": MANIFEST, "sha256": manifest_sha256},
        "truth": "SEQUENCE/truth/slot*.exr: mean radiance of each slot, and all passes",
        "passes": {
            name: {"channels": list(each.channels), "unit": each.unit, "axes": each.axes}
            for name, each in PASSES.items()
        },
        "conventions": CONVENTIONS,
        "cameras": cameras,
        "schemes": list(spec.schemes),
        "sequences": [
            {
                "name": each.name,
                "split": each.split,
                "scene": Path(each.scene).name,
                "variation": each.variation,
                "camera": each.camera,
                "seeds": list(spec.seeds) if spec.schemes else [],
            }
            for each in sequences
        ],
        "built": len(spec.sequences()),
        "filters": list(filters),
        "remarks": remarks(spec),
        "noise": _noise(spec, sequences, checks),
        "checks": {
            name: _worst(name, checks) for name in _CHECKS if any(name in each for each in checks.values())
        },
    }


def _camera(spec: DatasetSpec, name: str) -> Record:
    """Rates, exposure, gain and noise of a camera, in the terms of its data sheet."""
    sequence = next(each for each in spec.sequences() if each.camera == name)
    experiment = spec.experiment_of(sequence, spec.seeds[0])
    camera, view = experiment.camera, experiment.camera.view
    slot_s = experiment.timing.slot_s
    return {
        "slot_s": slot_s,
        "slots_a_second": 1 / slot_s,
        "slots_per_frame": camera.slots_per_frame,
        "frames_a_second": 1 / (slot_s * camera.slots_per_frame),
        "wavelength_nm": camera.wavelength_nm,
        "truth_samples_yx": [view.rows, view.cols],
        "panel_vu": [camera.panel_rows, camera.panel_cols],
        "ccd_yx": [camera.sensor.rows, camera.sensor.cols],
        "gain_e_per_dn": camera.sensor.step_e,
        "read_noise_e": camera.sensor.read_noise_e,
        "full_well_e": camera.sensor.full_well_e,
        "black_dn": camera.sensor.black_dn,
        "bits": camera.sensor.bits,
        "exposure": "SEQUENCE/seed*/light.json: neutral density by the light rule",
    }


def _noise(
    spec: DatasetSpec, sequences: Sequence[SequencePlan], checks: Mapping[str, Record]
) -> dict[str, Record]:
    """Noise of the truth asked of each split, and the largest and mean of its sequences."""
    found: dict[str, Record] = {}
    for split in SPLITS:
        names = [each.name for each in sequences if each.split == split]
        measured = [checks[name]["noise_rms"] for name in names if "noise_rms" in checks.get(name, {})]
        if measured:
            reached = {"worst": max(measured), "mean": float(np.mean(measured))}
            found[split] = {**spec.noise.of(split).model_dump(mode="json"), **reached}
    return found


def _worst(name: str, checks: Mapping[str, Record]) -> Record:
    what, choose = _CHECKS[name]
    found = {sequence: each[name] for sequence, each in checks.items() if name in each}
    sequence = choose(found, key=lambda key: found[key])
    return {
        "what": what,
        "worst": found[sequence],
        "in": sequence,
        "mean": float(np.mean(list(found.values()))),
    }


def manifest_lines(folder: Path, sequences: Sequence[SequencePlan]) -> list[str]:
    """Return a line of JSON for each file of the sequences: path, bytes, sha256."""
    lines: list[str] = []
    for each in sequences:
        for path in sorted(p for p in (folder / each.name).rglob("*") if p.is_file()):
            place = path.relative_to(folder).as_posix()
            record = {"path": place, "bytes": path.stat().st_size, "sha256": content_hash(path)}
            lines.append(json.dumps({**record, "split": each.split, "sequence": each.name}) + "\n")
    return lines


def croissant(about: Record) -> Record:
    """Describe a data set by MLCommons Croissant 1.0: the manifest is its table of files."""
    fields = {
        "path": "sc:Text",
        "bytes": "sc:Integer",
        "sha256": "sc:Text",
        "split": "sc:Text",
        "sequence": "sc:Text",
    }
    return {
        "@context": {
            "@language": "en",
            "@vocab": "https://schema.org/",
            "citeAs": "cr:citeAs",
            "column": "cr:column",
            "conformsTo": "dct:conformsTo",
            "cr": "http://mlcommons.org/croissant/",
            "data": {"@id": "cr:data", "@type": "@json"},
            "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
            "dct": "http://purl.org/dc/terms/",
            "extract": "cr:extract",
            "field": "cr:field",
            "fileObject": "cr:fileObject",
            "fileProperty": "cr:fileProperty",
            "fileSet": "cr:fileSet",
            "format": "cr:format",
            "includes": "cr:includes",
            "isLiveDataset": "cr:isLiveDataset",
            "jsonPath": "cr:jsonPath",
            "key": "cr:key",
            "md5": "cr:md5",
            "parentField": "cr:parentField",
            "path": "cr:path",
            "rai": "http://mlcommons.org/croissant/RAI/",
            "recordSet": "cr:recordSet",
            "references": "cr:references",
            "regex": "cr:regex",
            "repeated": "cr:repeated",
            "replace": "cr:replace",
            "sc": "https://schema.org/",
            "separator": "cr:separator",
            "source": "cr:source",
            "subField": "cr:subField",
            "transform": "cr:transform",
        },
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": about["name"],
        "description": about["description"] or about["name"],
        "license": f"https://spdx.org/licenses/{about['licence']}.html",
        "url": "README.md",
        "version": "1.0.0",
        "datePublished": about["made_utc"],
        "citeAs": f"{about['name']}, made with optsim {about['versions']['optsim']}",
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": "manifest",
                "name": MANIFEST,
                "contentUrl": MANIFEST,
                "encodingFormat": "application/jsonlines",
                "sha256": about["manifest"]["sha256"],
            }
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "files",
                "name": "files",
                "description": "One record a file, with its SHA-256, split and sequence.",
                "field": [
                    {
                        "@type": "cr:Field",
                        "@id": f"files/{name}",
                        "name": f"files/{name}",
                        "dataType": kind,
                        "source": {"fileObject": {"@id": "manifest"}, "extract": {"column": name}},
                    }
                    for name, kind in fields.items()
                ],
            }
        ],
    }


def _filtered(about: Record) -> list[str]:
    """Lines about filters: what each dropped, or that none did."""
    kept, built = len(about["sequences"]), about["built"]
    if not about["filters"]:
        return [f"No sequence was filtered out: {kept} of {built} kept."]
    return [
        f"{kept} of {built} sequences lie inside all filters and are kept.",
        "",
        "| filter | from | to | dropped |",
        "| --- | ---: | ---: | ---: |",
        *(
            f"| `{each['key']}`: {each['what']} | {each['range'][0]:g} | {each['range'][1]:g} | "
            f"{len(each['dropped'])} |"
            for each in about["filters"]
        ),
    ]


def _percent(share: float | None) -> str:
    return "as the experiment's" if share is None else f"{100 * share:.2g} %"


def readme(about: Record) -> str:
    """Write README.md of a data set: content, use, and results of the checks."""
    counts = Counter(each["split"] for each in about["sequences"])
    camera = next(iter(about["cameras"].values()))
    rows, cols = camera["truth_samples_yx"]
    lines = [
        f"# {about['name']}",
        "",
        about["description"] + ".",
        "",
        "![one row a sequence](contact_sheet.png)",
        "",
        f"{len(about['sequences'])} sequences ({', '.join(f'{counts[s]} {s}' for s in SPLITS)}), "
        "split by scene and variation.",
        f"Truth: {camera['slots_a_second']:g} slots a second of {cols} x {rows} samples.",
        f"Coded frames: {', '.join(about['schemes']) or 'none'}; {camera['slots_per_frame']} slots each.",
        "",
        "```python",
        "from optsim.dataset import open_dataset",
        "",
        'ds = open_dataset(".")',
        "sample = ds.train[0]",
        'print(sample["radiance"].shape, sample.unit("radiance"), sample.axes("radiance"))',
        "```",
        "",
        f"Licence: {about['licence']}. `dataset.json` states rates, gain, noise, units, axes and versions;",
        "`manifest.jsonl` has the SHA-256 of every file, which `optsim dataset verify .` checks.",
        "",
        "| check, measured in every sequence | worst | mean |",
        "| --- | ---: | ---: |",
        *(
            f"| {each['what']} | {each['worst']:.3g} ({each['in']}) | {each['mean']:.3g} |"
            for each in about["checks"].values()
        ),
        "",
        "| noise of the truth | asked | worst | mean | |",
        "| --- | ---: | ---: | ---: | --- |",
        *(
            f"| {split} | {_percent(each['share'])} | {_percent(each['worst'])} | {_percent(each['mean'])} | "
            f"{'each slot by itself' if each['independent'] else 'slots share it where nothing moves'}"
            f"{'; **not reached**' if each['worst'] > (each['share'] or np.inf) else ''} |"
            for split, each in about["noise"].items()
        ),
        "",
        "Rms over the picture of sigma over (radiance + 1 % of white), per fine sample, median of the slots.",
        "",
        "![stops below the brightest, and speeds](histograms.png)",
        "",
        *_filtered(about),
        *(f"\n{each[0].upper()}{each[1:]}." for each in about["remarks"]),
    ]
    if about["recipe"]:
        lines += ["", "Only the recipe is kept: `optsim dataset regenerate . NAME` makes a sequence again."]
    return "\n".join(lines) + "\n"
