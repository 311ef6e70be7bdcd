"""Evidence: effects validated against an oracle that isn't our code, and effects without validation.

``validation/<effect>/check.py`` states CLAIM, ORACLE, SOURCE, TOLERANCE with its REASON, and FILES, measures
a deviation, and measures it again on a stage broken on purpose. ``optsim validate --write`` stores the
records in ``evidence.json`` beside this file, each with a hash of the code that it covers. A file that FILES
names is covered. One that a wildcard of FILES matches is covered where imports reach it: those of the check,
or of a named file. An effect is *unvalidated* without a passing record or after a change of covered code, and
every report says so.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import cast

from optsim.core.code_hash import hash_code, imports_of
from optsim.core.errors import StorageError, unknown_name
from optsim.core.files import read_json, write_json
from optsim.core.folder_claims import claimed_file
from optsim.core.progress import Progress, silent
from optsim.report.schema import EvidenceRow

_RECORDS = Path(__file__).with_name("evidence.json")

# Every effect that a run models. Those without a folder in validation/ are printed as unvalidated.
EFFECTS: dict[str, str] = {
    "render_form_factor": "direct light from an area lamp",
    "render_furnace": "energy of multiple bounces",
    "difference_unbiased": "difference rendering, allocated samples and skipped paths: no bias",
    "interpolation_bound": "interpolation in time between rendered poses",
    "noise_calibrated": "noise of the truth where movers are, elsewhere, and with a moving camera",
    "depth_of_field": "defocus of the objective, and what hides what out of focus",
    "objective_distortion": "distortion of the objective",
    "stokes_malus": "polarised light through polarisers, in the Stokes pass",
    "stokes_brewster": "polarised gloss, in the Stokes pass",
    "analysed_gloss": "polarised scenes: gloss as the splitter passes it",
    "cos4": "radiance to irradiance, natural vignetting",
    "identities": "complementary codes, all-on, and a shift of scene and code, through the whole camera",
    "energy_balance": "energy through splitter, panel and relay",
    "white_field": "a uniform field through everything, to the electron: photon budget x shading",
    "photon_transfer": "sensor noise, gain and full well",
    "dark_current": "dark current by temperature, and its noise",
    "emva1288": "sensor statistics by the reference implementation of EMVA 1288",
    "calibration_recovers_camera": "what the virtual laboratory finds of the camera",
    "calibration_intervals": "how often the intervals of a calibration hold",
    "bench_by_another_program": "a bench that another program wrote",
    "hdr_wedge": "HDR merge over four decades",
    "static_hdr": "HDR merge of still pictures at four exposures, ideal weights and no panel",
    "pu21": "PU21 encoding of the scores",
    "scores": "every metric by region, and the intervals of scores",
    "panel_response": "first-order liquid-crystal response with history, late rows and unequal fields",
    "sync_jitter": "panel late on the shutter's clock, row by row, with jitter",
    "panel_uniformity": "reflectivity over the panel, and pixels that stand still",
    "fringing": "fringing fields between panel pixels",
    "lens_psf": "diffraction and aberration blur of each lens group",
    "moving_light": "blur of light that moves: middle, rest and far wings of a PSF, instant by instant",
    "field_psf": "wavefront aberrations over the field, by an independent optics library",
    "slanted_edge": "contrast of an edge through the whole chain",
    "mueller": "Mueller matrices of splitter and panel: signs, angles, and no light from nothing",
    "splitter_contrast": "system contrast of splitter, polarisers and panel",
    "veiling_glare": "uniform veiling glare of each lens group",
    "ghost": "mirrored, defocused ghost of the relay",
    "relay_overlap": "panel to CCD mapping at any ratio, with keystone and distortion",
    "lateral_colour": "scale of the relay's image by wavelength",
    "adjoints": "operators run backwards: relay, fringing, tracing, decoders",
    "skipping": "what a plan leaves out, over cameras, scenes and tolerances",
    "smear": "smear of an interline CCD",
}

# Effects that no part of the camera models; every report prints them.
NOT_MODELLED: tuple[str, ...] = (
    "aberrations beyond the third order; distortion of the objective beyond it, and its lateral colour",
    "the shape that a clipped pupil gives to PSFs and to what is out of focus",
    "change of scale and f-number with focus",
    "ghosts of the objective; glare is uniform",
    "light that thin panes polarise; the crossed component that the splitter lets in; stress birefringence",
    "dispersion of glass and liquid crystal; reflectivities and transmissions by band, but for the coating's",
    "twist of the liquid crystal",
    "ripple of the panel's light: with whole periods in a slot, as at the field rate, it changes no mean of "
    "a slot in which the panel stands still; slower, 1 % of it is up to 1 % of a slot (the effect fields is "
    "of the drive, which white hardly shows)",
    "what the splitter in collimated space takes from rows beside the middle: 1.2 % of white 5 mm off",
    "the error of the panel's grey curve beyond its exponent",
    "light that the relay's PSF throws beyond the panel's image",
    "sides of a panel pixel's image that keystone turns: at a keystone of 0.2 up to 4 % of its light is "
    "misplaced",
    "shading of the relay; defocus across a tilted panel; mirrors and gaps apart within a panel pixel",
    "blooming, lag, charge-transfer loss, hot pixels, fixed row or column patterns of the CCD; smear is that "
    "of the frame's own light",
    "motion within a truth instant, by default a slot: up to 0.3 of a frame's noise where a white bar moves "
    "3 pixels a slot (render.instants_per_slot)",
    "errors of what the bench is told: the scale of its irradiance is exact, and so is the retardance of "
    "white unless modulator.stated_half_wave_m says otherwise",
)


@dataclass(frozen=True)
class Evidence:
    """One effect's record.

    Parameters
    ----------
    effect, claim, oracle, source : str
        The claim, its reference, and the source of that.
    measured : float
        Deviation from the oracle; passes when its magnitude is at most the tolerance.
    perturbed : float
        The same measure with a stage broken on purpose; must exceed the tolerance.
    tolerance : float
        Bound of the deviation.
    reason : str
        Reason for the bound, and its unit.
    passed : bool
        Both conditions hold.
    files_hash : str
        Hash of the covered code (:func:`hash_code`).
    files : list of str
        Globs of the covered files.
    imports : list of str
        Dotted names that the check imports from the package.
    """

    effect: str
    claim: str
    oracle: str
    source: str
    measured: float
    perturbed: float
    tolerance: float
    reason: str
    passed: bool
    files_hash: str
    files: list[str]
    imports: list[str]


def records() -> dict[str, Evidence]:
    """Shipped records, by effect."""
    if not _RECORDS.is_file():
        return {}
    table = cast("list[dict[str, object]]", read_json(_RECORDS))
    return {e.effect: e for e in (Evidence(**row) for row in table)}  # pyright: ignore[reportArgumentType]


def status() -> list[EvidenceRow]:
    """State of every effect now: validated, or unvalidated and why."""
    kept = records()
    rows: list[EvidenceRow] = []
    for effect, what in EFFECTS.items():
        record = kept.get(effect)
        if record is None:
            why = "no validation yet"
        elif not record.passed:
            why = "the last validation failed"
        elif hash_code(record.files, record.imports) != record.files_hash:
            why = "changed since it was validated"
        else:
            why = ""
        rows.append(
            EvidenceRow(
                effect=effect,
                what=what,
                validated=not why,
                why=why,
                claim=record.claim if record else None,
                oracle=record.oracle if record else None,
                source=record.source if record else None,
                measured=record.measured if record else None,
                tolerance=record.tolerance if record else None,
                reason=record.reason if record else None,
            )
        )
    return rows


def check_names() -> list[str]:
    """Effects that have a check in the repository's validation folder."""
    return sorted(p.parent.name for p in _validation().glob("*/check.py"))


def measure(effect: str) -> Evidence:
    """Run one effect's check, and again on a stage broken on purpose."""
    if effect not in check_names():
        raise unknown_name("validation", effect, check_names())
    check = load_check(_validation() / effect / "check.py")
    measured, perturbed = float(check.measure()), float(check.perturbed())
    tolerance = float(check.TOLERANCE)
    # The wheel has no validation/: the covered code must be checkable where it is installed.
    files, imports = list(check.FILES), imports_of(_validation().glob(f"{effect}/*.py"))
    return Evidence(
        effect=effect,
        claim=check.CLAIM,
        oracle=check.ORACLE,
        source=check.SOURCE,
        measured=measured,
        perturbed=perturbed,
        tolerance=tolerance,
        reason=check.REASON,
        passed=abs(measured) <= tolerance < abs(perturbed),
        files_hash=hash_code(files, imports),
        files=files,
        imports=imports,
    )


def measure_all(names: Sequence[str], *, write: bool, progress: Progress = silent) -> list[Evidence]:
    """Run checks (all of them when no name is given), and store the records if asked to."""
    chosen = list(names) or check_names()
    for name in chosen:
        if name not in check_names():
            raise unknown_name("validation", name, check_names())
    found: list[Evidence] = []
    with claimed_file(_RECORDS) if write else nullcontext():
        kept = records()
        for done, name in enumerate(chosen):
            progress(f"validate {name}", done, len(chosen))
            found.append(measure(name))
            kept[name] = found[-1]
            if write:
                # One by one: finished records stay when a later check is interrupted.
                write_json(_RECORDS, [asdict(kept[each]) for each in sorted(kept)])
    progress("validate", len(chosen), len(chosen))
    return found


def _validation() -> Path:
    folder = Path(__file__).parents[2] / "validation"
    if not folder.is_dir():
        raise StorageError(
            "validation needs the repository: its checks are not part of the installed package. "
            "Cure: clone the repository and run 'make validate' there."
        )
    return folder


def load_check(path: Path) -> ModuleType:
    """Import a check from its file."""
    spec = importlib.util.spec_from_file_location(f"validation_{path.parent.name}", path)
    if spec is None or spec.loader is None:
        raise StorageError(f"{path} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
