"""Old module names: an import by one still works, with a warning."""

from __future__ import annotations

import importlib
import sys
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

# Room -> modules that lay at the top of the package, or were packages of their own.
_FROM_THE_TOP = {
    "core": "errors config descriptions units problems files progress cache console stopwatch quantities "
    "foreign",
    "camera": "effects effect_sizes geometry ledger hardware laboratory bench_calibration",
    "experiment": "loop job explain trace truth evidence scoring densities object_masks focus measurement "
    "train",
    "app": "cli doctor catalogue",
}
_RENAMED = {
    "calibrate": "optsim.calibration",
    "calibrate.sample": "optsim.calibration.demixed",
    "camera_table": "optsim.camera.table",
    "claims": "optsim.core.folder_claims",
    "experiment_schema": "optsim.experiment.schema",
    "experiment.finished": "optsim.experiment.run_folder",
    "experiment.imported_clips": "optsim.footage.clips",
    "experiment.journal": "optsim.experiment.resume",
    "experiment.run_calibrations": "optsim.experiment.run_folder",
    "experiment.run_frames": "optsim.experiment.run_folder",
    "finished": "optsim.experiment.run_folder",
    "forward": "optsim.optics",
    "forward.bands": "optsim.core.threads",
    "forward.compiled": "optsim.core.compiled",
    "gallery": "optsim.experiment.figures",
    "imported_clips": "optsim.footage.clips",
    "journal": "optsim.experiment.resume",
    "knowledge": "optsim.calibration.choice",
    "known_calibration": "optsim.camera.true_calibration",
    "optics.bands": "optsim.core.threads",
    "origins": "optsim.experiment.signal_breakdown",
    "own_f_number": "optsim.study.own_f_number",
    "optics.wings": "optsim.optics.psf_tails",
    "coding.tiles": "optsim.coding.periodic",
    "passes": "optsim.dataset",
    "reconstruct": "optsim.decoding",
    "reconstruct.branches": "optsim.decoding.partial_decoders",
    "reconstruct.layer": "optsim.decoding.partial",
    "run_calibrations": "optsim.experiment.run_folder",
    "run_frames": "optsim.experiment.run_folder",
    "scene.footage": "optsim.footage.made",
    "scene.footage_source": "optsim.footage.source",
    "scene.footage_truth": "optsim.footage.truth",
    "scene.recording": "optsim.footage.recording",
    "sensor": "optsim.camera.parts",
}
MOVED = {
    **{
        f"optsim.{name}": f"optsim.{room}.{name}"
        for room, names in _FROM_THE_TOP.items()
        for name in names.split()
    },
    **{f"optsim.{old}": new for old, new in _RENAMED.items()},
}


def new_name(old: str) -> str | None:
    """Name that a module has now; None where it has no other."""
    head, rest = old, ""
    while head not in MOVED:
        head, _, last = head.rpartition(".")
        if not head:
            return None
        rest = f".{last}{rest}"
    return MOVED[head] + rest


class OldNames(MetaPathFinder, Loader):
    """Finds modules by their old names."""

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        """Claim a module that has another name now."""
        if not name.startswith("optsim.") or new_name(name) is None:
            return None
        return ModuleSpec(name, self, is_package=True)

    def exec_module(self, module: ModuleType) -> None:
        """Put the module that has its name now in its place."""
        old = module.__name__
        new = new_name(old) or old
        warnings.warn(f"{old} is {new} now", DeprecationWarning, stacklevel=2)
        sys.modules[old] = importlib.import_module(new)
