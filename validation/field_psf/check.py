"""PSFs over the field by an independent optics library, for objective and relay of the prototype.

Run as a program it prints what is behind the one number of the evidence: ``check.py`` the light misplaced at
every place; ``check.py breaks`` what the check says of lenses made wrong on purpose.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[2]))  # the checks are files, not a package

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import prototype
from optsim.camera.parts import form_image
from optsim.core.errors import StorageError
from optsim.footage.made import still
from optsim.optics.aberrations import Wavefront
from optsim.optics.field_blur import FieldPsf
from validation.environments import reference_python

CLAIM = (
    "points at the centre, halfway and in the corners, at and between the nodes of the field's grid, spread "
    "as the third-order wavefront of objective and relay makes them, in focus and 0.1 mm out of it"
)
ORACLE = (
    "package prysm 0.21.1, run as a separate program: its Zernike polynomials, propagation of a pupil of "
    "1024 samples, 9 x 9 samples a cell; the field's dependence written out here; numpy and scipy"
)
SOURCE = (
    "B. Dube, prysm, J. Open Source Softw. 4, 1352, 2019 (MIT licence); M. Born and E. Wolf, Principles of "
    "Optics, 7th ed., section 5.3 (field dependence); R. J. Noll, J. Opt. Soc. Am. 66, 207, 1976"
)
TOLERANCE = 1.0
REASON = "In units of what each place is allowed, below; it is a share of the point's light."
FILES = (
    "optsim/optics/psf.py",
    "optsim/optics/aberrations.py",
    "optsim/optics/field_blur.py",
    "optsim/camera/parts/*.py",
    "optsim/camera/hardware/cameras.py",
)

# At a node: 1e-3 of the light lies beyond the window and is put back, 64 samples across the pupil leave a rim
# of 2e-3, the sum of four samples for an integral over a cell another 1e-3. Between them also what the lens
# says of itself.
_AT_NODES = 0.005
_WAVELENGTH_M, _PITCH_M = 550e-9, 20e-6
_DEFOCUS_M = 1e-4
# Places that an odd number of nodes has among them, as shares of the half sides: down, right.
_NODES = ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
# Points of light that go through the whole image: neither node nor middle, all signs.
_POINTS = ((-0.55, 0.35), (0.71, 0.83), (0.66, -0.79))

Case = tuple[str, float, float, float, FieldPsf]  # lens, f-number, side of a cell, defocus, PSF


def measure() -> float:
    """Light misplaced over what is allowed, at the worst place."""
    return max(_ratios(_camera()).values())


def perturbed() -> float:
    """With coma a fifth larger in both lenses."""
    return max(_ratios(_with(coma_waves=1.2)).values())


def _camera() -> CodedCamera:
    """Return the prototype with its CCD in the paraxial image, which the oracle's defocus is counted from."""
    camera = prototype()
    return camera.model_copy(update={"relay": camera.relay.model_copy(update={"focus": "paraxial"})})


def _with(defocus: float = 1.0, kind: type[Wavefront] = Wavefront, **factors: float) -> CodedCamera:
    """Camera whose wavefronts are another kind or have terms multiplied, and whose defocus is."""
    camera = _camera()
    terms = {k: v * factors.get(k, 1.0) for k, v in camera.relay.wavefront.model_dump().items()}
    wrong = {"wavefront": kind(**terms)}
    relay = camera.relay.model_copy(update={**wrong, "defocus_m": (defocus - 1) * _DEFOCUS_M})
    return camera.model_copy(update={"relay": relay, "objective": camera.objective.model_copy(update=wrong)})


def _ratios(camera: CodedCamera) -> dict[str, float]:
    """Share of a point's light that is misplaced over what is allowed, by lens and place."""
    return {name: share / allowed for name, (share, allowed) in _shares(camera).items()}


def _shares(camera: CodedCamera) -> dict[str, tuple[float, float]]:
    """Share of a point's light that is misplaced, and what is allowed, by lens and place."""
    found: dict[str, tuple[float, float]] = {}
    between = _AT_NODES + camera.relay.field_error
    for lens, f_number, cell_m, defocus_m, psf in _cases(camera):
        step = 1 / (len(psf.cores) - 1)  # half a cell of the grid of nodes
        middles = ((1 - step, 1 - step), (step, -step), (-1 + step, 0.5 + step))
        for places, allowed in ((_NODES, _AT_NODES), (middles, between)):
            for place in places:
                ours, true = psf.at(*place), _by_library(place, f_number, cell_m, defocus_m, psf.half)
                found[f"{lens} {place[0]:+.3f} {place[1]:+.3f}"] = _misplaced(ours, true), allowed
    for lens, place, seen in _points(camera):
        f_number, cell_m = _numbers(camera)[lens]
        true = _by_library(place, f_number, cell_m, 0.0, len(seen) // 2)
        found[f"{lens}, image {place[0]:+.3f} {place[1]:+.3f}"] = _misplaced(seen, true), between
    return found


def _misplaced(ours: np.ndarray, true: np.ndarray) -> float:
    return float(np.abs(ours - true).sum() / 2)


def _numbers(camera: CodedCamera) -> dict[str, tuple[float, float]]:
    """f-number and side of a fine cell in each lens's image."""
    cone, cell_m = camera.objective.working_f_number, _PITCH_M / 3
    relay = camera.relay
    on_ccd = (relay.image_f_number(cone), cell_m * relay.magnification)
    return {"objective": (cone, cell_m), "relay": on_ccd}


def _cases(camera: CodedCamera) -> list[Case]:
    numbers, sides = _numbers(camera), (camera.view.rows, camera.view.cols)
    found: list[Case] = []
    for lens, group, wanted_m, set_m in (
        ("objective", camera.objective, 0.0, 0.0),
        ("relay", camera.relay, 0.0, 0.0),
        ("relay, 0.1 mm out of focus", camera.relay, _DEFOCUS_M, _DEFOCUS_M + camera.relay.defocus_m),
    ):
        f_number, cell_m = numbers[lens.split(",")[0]]
        psf = group.psf(f_number, cell_m, sides, set_m)
        found.append((lens, f_number, cell_m, wanted_m, psf))
    return found


def _points(camera: CodedCamera) -> list[tuple[str, tuple[float, float], np.ndarray]]:
    """Points of light through the whole image of each lens: lens, place, and the light around it."""
    shape = (camera.view.rows, camera.view.cols)
    cells = [tuple(int((c + 1) / 2 * n) for c, n in zip(p, shape, strict=True)) for p in _POINTS]
    picture = np.zeros(shape, np.float32)
    for cell in cells:
        picture[cell] = 1.0
    bare = camera.objective.model_copy(update={"glare_share": 0.0, "natural_vignetting": False})
    scene = still(picture, n_slots=1, slot_s=1.0, samples_per_pitch=3)
    image = form_image(bare, scene, _PITCH_M, 1).load(0).start / bare.irradiance_per_radiance
    sharp = camera.model_copy(update={"relay": camera.relay.model_copy(update={"defocus_m": 0.0})})
    images = {"objective": image, "relay": sharp.relay_operator().blur.apply(picture)}
    half, found = 60, []
    for lens, light in images.items():
        for row, col in cells:
            place = ((row + 0.5) / shape[0] * 2 - 1, (col + 0.5) / shape[1] * 2 - 1)
            around = light[row - half : row + half + 1, col - half : col + half + 1]
            found.append((lens, place, np.asarray(around, float)))
    return found


# -- the oracle -------------------------------------------------------------------------------------------


def _job(
    place: tuple[float, float], f_number: float, cell_m: float, defocus_m: float, half: int
) -> dict[str, object]:
    """Tell the library Noll's coefficients of the prototype's lenses at a place, waves rms, and the rest."""
    spherical, coma, astigmatism, curvature = 0.07, 0.139, 0.139, 0.139
    y, x = place[0] * 500 / np.hypot(500, 600), place[1] * 600 / np.hypot(500, 600)
    height, angle = np.hypot(y, x), np.arctan2(y, x)
    noll = {
        4: curvature * height**2,
        5: astigmatism * height**2 * np.sin(2 * angle),
        6: astigmatism * height**2 * np.cos(2 * angle),
        7: coma * height * np.sin(angle),
        8: coma * height * np.cos(angle),
        11: spherical,
    }
    # Every cell sends from its centre; its own variance is taken out of the Gaussian (forward/psf.py).
    sigma_m = float(np.sqrt(max(2e-6**2 - cell_m**2 / 12, 0.0)))
    numbers = {"f_number": f_number, "wavelength_m": _WAVELENGTH_M, "defocus_m": defocus_m}
    return {"noll": noll, "sigma_m": sigma_m, "cell_m": cell_m, "half": half, **numbers}


@cache
def _by_library(
    place: tuple[float, float], f_number: float, cell_m: float, defocus_m: float, half: int
) -> np.ndarray:
    program = str(Path(__file__).with_name("reference.py"))
    with tempfile.TemporaryDirectory() as folder:
        job, result = Path(folder, "job.json"), Path(folder, "psf.npy")
        job.write_text(json.dumps(_job(place, f_number, cell_m, defocus_m, half)))
        # -I: neither variables nor folders of this environment reach that one.
        command = [str(reference_python("field_psf")), "-I", program, str(job), str(result)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise StorageError(f"the optics library failed: {done.stderr.strip()[-600:]}")
        return np.load(result)


# -- what is behind the one number ------------------------------------------------------------------------


class _CurvatureLinear(Wavefront):
    def at(self, field_y: float, field_x: float, pupil_y: np.ndarray, pupil_x: np.ndarray) -> np.ndarray:
        height = np.hypot(field_y, field_x)
        flat = self.model_copy(update={"curvature_waves": 0.0})
        bent = self.curvature_waves * height * np.sqrt(3) * (2 * (pupil_y**2 + pupil_x**2) - 1)
        return Wavefront.at(flat, field_y, field_x, pupil_y, pupil_x) + bent


def print_breaks() -> None:
    breaks = {
        "none": _with(),
        "coma a fifth larger": _with(coma_waves=1.2),
        "coma towards the axis": _with(coma_waves=-1.0),
        "coma without Noll's factor": _with(coma_waves=8**-0.5),
        "astigmatism turned by 90 degrees": _with(astigmatism_waves=-1.0),
        "astigmatism without Noll's factor": _with(astigmatism_waves=6**-0.5),
        "curvature of the other sign": _with(curvature_waves=-1.0),
        "curvature linear in the field": _with(kind=_CurvatureLinear),
        "spherical of the other sign": _with(spherical_waves=-1.0),
        "spherical a fifth larger": _with(spherical_waves=1.2),
        "defocus of the other sign": _with(defocus=-1.0),
        "defocus 5 % larger": _with(defocus=1.05),
    }
    for name, camera in breaks.items():
        ratios = _ratios(camera)
        worst = max(ratios, key=lambda place: ratios[place])
        over = sum(r > 1 for r in ratios.values())
        print(f"{name:36s}{ratios[worst]:7.2f} at {worst:42s}{over:4d} of {len(ratios)} over")


if __name__ == "__main__":
    if sys.argv[1:] == ["breaks"]:
        print_breaks()
    else:
        for name, (share, allowed) in _shares(_camera()).items():
            print(f"{name:44s}{share:8.4f} of {allowed:.3f}")
