"""Export of the truth with all its passes: one OpenEXR a slot, a manifest, one overview image.

Radiance is the mean over the slot. All other passes are of the instant in the middle of the slot, and flow
goes to the middles of the next and of the last slot.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from optsim.camera.effects import with_effects
from optsim.core.cache import hash_of
from optsim.core.errors import BackendError, ConfigError, StorageError
from optsim.core.files import CLAIM, content_hash, read_exr, read_json, write_exr, write_json, write_png8
from optsim.core.folder_claims import claimed
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Passes, RadianceVideo
from optsim.dataset.channels import (
    CONVENTIONS,
    HALF_CHANNELS,
    OWN_NOISE,
    UNITS,
    channels_of,
    noise_sigma,
    slot_mean,
)
from optsim.dataset.extras import ExtraChannels, Extras, channel_names
from optsim.experiment.experiment import Experiment
from optsim.experiment.run_folder import libraries
from optsim.experiment.truth import chosen_scene, render_truth, renderer, truth_view, whole_scene
from optsim.report.pass_sheet import pass_sheet

_KIND = "optsim passes 2"
_MANIFEST = "manifest.json"
_PICTURE = "passes.png"
# Bytes of a sample in a file, before compression: 19 channels of 32 bits.
_SAMPLE_BYTES = 76
# Defines the share of noise, both requested and measured.
_SHARE = "rms over the picture of the standard deviation of Y over (Y + 1 % of the scene's white)"

Record = dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Export:
    """Destination and source of an export."""

    folder: Path
    experiment: Experiment
    identity: str
    half: tuple[str, ...]
    extras: Extras
    band_nm: float
    made_by: dict[str, str]
    noise_share: float | None

    def path(self, slot: int) -> Path:
        return self.folder / f"slot{slot:06d}.exr"

    def header(self) -> Record:
        """Return the common part of manifest and files."""
        return {
            "kind": _KIND,
            "identity": self.identity,
            "units": UNITS,
            "conventions": CONVENTIONS | ({"noise": OWN_NOISE} if self.noise_share else {}),
            "noise": {
                "independent": self.noise_share is not None,
                "target_share": self.noise_share,
                "share": _SHARE,
            },
            "half": list(self.half),
            "extras": self.extras.model_dump(mode="json"),
            "slot_s": self.experiment.timing.slot_s,
            "band_nm": self.band_nm,
            "scene": self.experiment.model_dump(mode="json")["scene"],
            "render": self.experiment.render.model_dump(mode="json"),
            "versions": self.made_by,
        }


def export_passes(
    experiment: Experiment,
    folder: Path,
    slots: range | None = None,
    *,
    half: bool = False,
    extras: Extras | None = None,
    independent_noise: bool = False,
    noise_share: float | None = None,
    backend: str | None = None,
    progress: Progress = silent,
) -> None:
    """Write slots of an experiment's truth with all passes: ``slot000000.exr``, manifest and an image.

    An interrupted export resumes, and a later one with other slots adds to it: complete files are kept.

    Parameters
    ----------
    experiment : Experiment
        It must have a scene: footage has no surfaces.
    folder : Path
        New, empty, or with an export of the same truth.
    slots : range, optional
        Slots to export, default all.
    half : bool
        Store radiance, normals and albedo as 16 bit; ids, depth, flow and noise never.
    extras : Extras, optional
        Further channels; none by default.
    independent_noise : bool
        Render every slot separately, static parts too, so that no two share their noise.
    noise_share : float, optional
        The same, until the noise of each slot is this share of (radiance + 1 % of white), rms over the
        image, instead of ``render.static_error``; 0.001 to 1.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Called after each slot, as "passes".

    Raises
    ------
    ConfigError
        For footage, slots outside of the experiment, a share of noise out of range, or denoising that is not
        installed.
    StorageError
        When the folder holds other files, another process writes into it, or the disk is too full.
    BackendError
        When polarised light or independent noise is requested and only the scalar fallback works.
    """
    from optsim.render import PassRenderer

    slots, extras = check_slots(experiment, slots), extras or Extras()
    extras.check(backend)
    share = _chosen_share(experiment, independent_noise, noise_share, backend)
    scene, view, slot_s = chosen_scene(experiment), truth_view(experiment), experiment.timing.slot_s
    made_by = {**libraries(), "variant": renderer(experiment, backend)[0]}
    if extras.denoise:
        made_by["mitsuba-oidn"] = version("mitsuba-oidn")
    settings = experiment.render.model_dump(mode="json")
    whole = whole_scene(experiment)
    more = channel_names(extras, whole)
    identity = hash_of(
        *(_KIND, scene.model_dump(mode="json"), whole.model_dump(mode="json"), asdict(view), slot_s),
        *(settings, half, extras.model_dump(mode="json"), made_by, scene.categories),
        *(() if share is None else ("independent noise", share)),
    )
    short = (*HALF_CHANNELS, *more) if half else ()
    band_nm = experiment.camera.wavelength_nm
    export = _Export(folder, experiment, identity, short, extras, band_nm, made_by, share)
    with claimed(folder):
        files = _found(export)
        missing = [slot for slot in slots if slot not in files]
        _check_disk(folder, len(missing) * view.rows * view.cols * (_SAMPLE_BYTES + 4 * len(more)))
        _write_manifest(export, files, complete=not missing)
        if missing:
            # An export is for other cameras too, without this splitter: polarisation is a separate channel.
            plain = with_effects(experiment.camera, {"polarised_scene": "ideal"})
            light = experiment.model_copy(update={"camera": plain})
            radiance = render_truth(light, backend=backend, slot_error=share, progress=progress)
            look = PassRenderer(scene, view, backend=backend)
            further = ExtraChannels(
                extras, experiment, missing, shared=share is None, backend=backend, progress=progress
            )
            for done, slot in enumerate(missing, start=1):
                passes = look.at((slot + 0.5) * slot_s, slot_s)
                measured = _write_slot(export, slot, passes, radiance, further)
                files[slot] = _record(export.path(slot), slot, measured)
                progress("passes", done, len(missing))
            _write_manifest(export, files, complete=True)
        _write_picture(export, slots[len(slots) // 2])


def _write_slot(
    export: _Export, slot: int, passes: Passes, radiance: RadianceVideo, further: ExtraChannels
) -> float | None:
    """Write a slot's file; return the measured share of its noise."""
    from optsim.render.plan import measured_error

    mean, half, sigma, measured = slot_mean(radiance, slot), None, None, None
    if radiance.half_difference is not None:
        half = slot_mean(radiance.half_difference, slot)
        sigma, measured = noise_sigma(half, passes.parts), measured_error(mean, half, radiance.white_w_m2_sr)
    more, said = further.of(slot, passes, mean, half)
    write_exr(
        export.path(slot),
        {**channels_of(passes, mean, sigma), **more},
        attributes={**_attributes(export, passes, slot), "noise_share": measured, "further": said},
        half=export.half,
    )
    return measured


def parse_slots(text: str) -> range:
    """Read ``FIRST:LAST``, LAST not included, as a range.

    Raises
    ------
    ConfigError
        For anything else.
    """
    first, colon, last = text.partition(":")
    if not (colon and first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise ConfigError(
            f"--slots: got {text!r}, expected FIRST:LAST, LAST not included, for example 0:36 for a frame"
        )
    return range(int(first), int(last))


def check_slots(experiment: Experiment, slots: range | None) -> range:
    """Return the requested slots, all by default; a ConfigError unless they are some of the experiment's."""
    n_slots = experiment.timing.n_slots
    if slots is None:
        return range(n_slots)
    if not slots or slots[0] < 0 or slots[-1] >= n_slots:
        raise ConfigError(
            f"--slots: got {slots.start}:{slots.stop}, expected some of the {n_slots} slots 0:{n_slots} of "
            f"{experiment.name}; for more, --set n_frames=..."
        )
    return slots


def _chosen_share(
    experiment: Experiment, independent: bool, share: float | None, backend: str | None
) -> float | None:
    """Noise share of independently rendered slots; None where slots may have noise in common."""
    if share is not None and not 0.001 <= share <= 1:
        raise ConfigError(
            f"--noise-share: got {share:g}, expected 0.001 to 1; cure: --noise-share 0.01, for 1 %"
        )
    if share is None and not independent:
        return None
    from optsim import render

    report = render.choose_backend(backend)
    if report.preview:
        raise BackendError(
            f"--independent-noise, --noise-share: got {report.variant} ({report.reason}), expected "
            "llvm_ad_mono or cuda_ad_mono; cure: 'optsim doctor', or leave them out"
        )
    return experiment.render.static_error if share is None else share


def _found(export: _Export) -> dict[int, Record]:
    """Find the existing complete slots, by number; refuse a folder with other files."""
    folder = export.folder
    # A killed export leaves a hidden file with this ending; it is no content.
    halves = list(folder.glob(".*.part.*"))
    if {*folder.iterdir()} <= {*halves, folder / CLAIM}:
        return {}
    if not (folder / _MANIFEST).is_file():
        raise StorageError(
            f"--out {folder} is not empty and holds no export of passes; choose a new or an empty folder"
        )
    manifest: Record = read_json(folder / _MANIFEST)
    if manifest.get("identity") != export.identity:
        raise StorageError(
            f"--out {folder} holds an export of another truth: another scene, render settings, versions, "
            "further channels, noise or --half; choose another folder"
        )
    for half in halves:
        half.unlink(missing_ok=True)
    listed: dict[int, Record] = {int(item["slot"]): item for item in manifest["files"]}
    files: dict[int, Record] = {}
    for path in sorted(folder.glob("slot*.exr")):
        slot = int(path.stem.removeprefix("slot"))
        # A listed file that was damaged since has another hash; one finished after the list was written is
        # read itself.
        record = listed.get(slot) or _own_record(export, path, slot)
        if record is not None and record == _record(path, slot, record["noise_share"]):
            files[slot] = record
    return files


def _own_record(export: _Export, path: Path, slot: int) -> Record | None:
    """Record of a file if it states that it is this export's slot."""
    try:
        attributes = read_exr(path)[1]
    except StorageError:
        return None
    if attributes.get("identity") != export.identity or attributes.get("slot") != slot:
        return None
    return _record(path, slot, attributes["noise_share"])


def _record(path: Path, slot: int, measured: float | None) -> Record:
    return {
        "file": path.name,
        "slot": slot,
        "bytes": path.stat().st_size,
        "sha256": content_hash(path),
        "noise_share": measured,
    }


def _write_manifest(export: _Export, files: dict[int, Record], *, complete: bool) -> None:
    view = export.experiment.camera.view
    write_json(
        export.folder / _MANIFEST,
        {
            **export.header(),
            "complete": complete,
            "shape": [view.rows, view.cols],
            "samples_per_panel_pixel": view.samples_per_pitch,
            "experiment": export.experiment.model_dump(mode="json"),
            "picture": _PICTURE,
            "files": [files[slot] for slot in sorted(files)],
        },
    )


def _check_disk(folder: Path, need_bytes: int) -> None:
    existing = next(p for p in [folder.absolute(), *folder.absolute().parents] if p.exists())
    free_mb, need_mb = shutil.disk_usage(existing).free / 1e6, need_bytes / 1e6
    if need_mb > free_mb:
        raise StorageError(
            f"not enough disk for the passes at {folder}: up to {need_mb:.0f} MB are needed, "
            f"{free_mb:.0f} MB are free; cure: fewer slots by --slots FIRST:LAST, --half, or another --out"
        )


def _attributes(export: _Export, passes: Passes, slot: int) -> Record:
    slot_s = export.experiment.timing.slot_s
    return {
        **export.header(),
        "slot": slot,
        "slot_start_s": slot * slot_s,
        "slot_stop_s": (slot + 1) * slot_s,
        "times_s": list(passes.times_s),
        "intrinsics_px": passes.intrinsics_px.tolist(),
        "radial_k1": passes.radial_k1,
        "camera_to_world": passes.camera_to_world.tolist(),
        "id_table": {str(number): name for number, name in passes.id_table.items()},
        "part_table": {
            str(part): {"id": number, "name": name} for part, (number, name) in passes.part_table.items()
        },
        "objects": {
            str(number): {
                "name": passes.id_table[number],
                "category": each.category,
                "box_px": each.box_px,
                "visible_box_px": each.visible_box_px,
                "visible": each.visible,
                "covered": each.covered,
                "visibility": each.visibility,
                "box_m": {
                    "center": each.center_m.tolist(),
                    "size": each.size_m.tolist(),
                    "axes": each.axes.tolist(),
                },
            }
            for number, each in passes.extents.items()
        },
        "object_poses": {
            name: {
                "world_at_0_to_world": None if pose.matrices is None else pose.matrices.tolist(),
                "reason": pose.reason,
                "center_m": pose.center_m.tolist(),
            }
            for name, pose in passes.object_poses.items()
        },
    }


def _write_picture(export: _Export, slot: int) -> None:
    channels, said = read_exr(export.path(slot))
    names = {int(number): name for number, name in said["id_table"].items()}
    title = f"{export.experiment.name}, slot {slot}, t = {1e3 * said['times_s'][1]:.3f} ms"
    write_png8(export.folder / _PICTURE, pass_sheet(channels, names, title))
