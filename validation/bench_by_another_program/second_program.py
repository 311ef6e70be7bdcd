"""Write the bench of a made camera: numpy and the standard library alone, no line of optsim.

    python second_program.py FOLDER

The camera is a plain one: each panel pixel is a square, blurred by a Gaussian, at a place by a formula. Its
panel relaxes exponentially, row after row. Its CCD has shot noise, read noise, fixed patterns and a full
well. ``bench.json`` is written by hand as docs/how-to/calibration.md says.
"""

from __future__ import annotations

import json
import math
import struct
import sys
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

HALF = 7  # half width of a panel pixel's window, CCD pixels
SLOT_S, SLOTS = 1 / 180, 36
FLASH = 0.1  # of a slot
DELAYS = (-0.5, -0.2, 0.0, 0.1, 0.2, 0.4, 0.7, 1.1, 1.6)
ERF = np.frompyfunc(math.erf, 1, 1)


@dataclass(frozen=True)
class Camera:
    """The true numbers; lengths in CCD pixels where nothing else is said.

    ``tilt`` reduces the last column's image against the middle one. ``barrel`` is the relative change of the
    distance from the middle at the corners, with its square; ``fifth`` a shift of up to so many pixels at the
    left and right edge, growing with the fifth power, which no map of third order follows.
    """

    panel: tuple[int, int] = (48, 64)
    ccd: tuple[int, int] = (170, 222)
    ratio: float = 3.0
    shift: tuple[float, float] = (0.0, 0.0)
    rotation: float = 0.0
    magnification: float = 1.0
    tilt: float = 0.0
    barrel: float = 0.0
    fifth: float = 0.0
    blur: float = 0.9
    leak: float = 0.01
    tau_on_s: float = 0.5e-3
    tau_off_s: float = 1.0e-3
    delay_s: float = 0.2e-3
    scan_s: float = 0.8e-3
    exponent: float = 1.2
    dn_per_e: float = 0.7
    read_e: float = 9.4
    full_well_e: float = 15770.0
    black_dn: float = 200.0
    veil: float = 0.004

    def places(self, points: np.ndarray) -> np.ndarray:
        """CCD coordinates (y, x) of panel coordinates (v, u), (n, 2)."""
        half = np.array(self.panel) / 2
        away = points - half
        scale = 1 + self.barrel * (away**2).sum(axis=1) / (half**2).sum()
        scale = scale / (1 + self.tilt * away[:, 1] / half[1])
        dy, dx = (away * scale[:, None]).T * self.ratio * self.magnification
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        y, x = c * dy + s * dx, c * dx - s * dy
        x = x + self.fifth * (away[:, 1] / half[1]) ** 5
        return np.stack([y + self.ccd[0] / 2 + self.shift[0], x + self.ccd[1] / 2 + self.shift[1]], axis=1)

    def centres(self) -> np.ndarray:
        """CCD coordinates of the centres of the panel's pixels, (v * u, 2)."""
        return self.places(np.indices(self.panel).reshape(2, -1).T + 0.5)

    def truth(self) -> dict[str, float]:
        """Return what a calibration should find."""
        return {
            "leak": self.leak,
            "tau_on_s": self.tau_on_s,
            "tau_off_s": self.tau_off_s,
            "delay_s": self.delay_s,
            "scan_s": self.scan_s,
            "drive_exponent": self.exponent,
            "dn_per_e": self.dn_per_e,
            "read_noise_dn": math.sqrt((self.read_e * self.dn_per_e) ** 2 + 1 / 12),
        }


def smooth_box(x: np.ndarray, side: float, sigma: float) -> np.ndarray:
    """Integral up to x of a unit box of a side, blurred by a Gaussian."""

    def ramp(z: np.ndarray) -> np.ndarray:
        gauss = np.exp(-((z / sigma) ** 2) / 2) * sigma / math.sqrt(2 * math.pi)
        return z / 2 * (1 + ERF(z / sigma / math.sqrt(2)).astype(float)) + gauss

    return (ramp(x + side / 2) - ramp(x - side / 2)) / side


class Laboratory:
    """A camera with its light sources and its noise."""

    def __init__(self, camera: Camera, seed: int) -> None:
        self.camera, self.rng = camera, np.random.default_rng(seed)
        side = camera.ratio * camera.magnification
        span = np.arange(-HALF, HALF + 1)
        shares, pixels = [], []
        for at, size in zip(camera.centres().T, camera.ccd, strict=True):
            first = np.floor(at).astype(int)[:, None] + span
            off = first - at[:, None]
            shares.append(smooth_box(off + 1.0, side, camera.blur) - smooth_box(off + 0.0, side, camera.blur))
            pixels.append(np.where((first >= 0) & (first < size), first, -1))
        self.share = (shares[0][:, :, None] * shares[1][:, None, :]).reshape(len(shares[0]), -1) * side**2
        on = (pixels[0][:, :, None] >= 0) & (pixels[1][:, None, :] >= 0)
        where = pixels[0][:, :, None] * camera.ccd[1] + pixels[1][:, None, :]
        self.share[~on.reshape(self.share.shape)] = 0
        np.maximum(self.share, 0, out=self.share)  # rounding
        self.where = np.where(on, where, 0).reshape(self.share.shape).ravel()
        y, x = (np.arange(n)[:, None] / n - 0.5 for n in camera.ccd)
        self.response = 1 - 0.3 * (y**2 + x.T**2) + self.rng.normal(0, 0.008, camera.ccd)
        self.black = camera.black_dn + self.rng.normal(0, 1.5, camera.ccd)

    def image(self, light: np.ndarray, n_frames: int) -> np.ndarray:
        """Take frames of some light on the panel, electrons on a CCD pixel in its image, (v, u)."""
        camera, size = self.camera, self.camera.ccd[0] * self.camera.ccd[1]
        at = np.bincount(self.where, (self.share * light.reshape(-1, 1)).ravel(), size).reshape(camera.ccd)
        electrons = ((1 - camera.veil) * at + camera.veil * at.mean()) * self.response
        taken = np.minimum(self.rng.poisson(electrons, (n_frames, *camera.ccd)), camera.full_well_e)
        noisy = taken + self.rng.normal(0, camera.read_e, taken.shape)
        return np.clip(np.round(noisy * camera.dn_per_e + self.black), 0, 65535).astype(np.uint16)

    def weight(self, levels: np.ndarray) -> np.ndarray:
        """Transmission of held levels."""
        camera = self.camera
        return camera.leak + (1 - camera.leak) * np.sin(math.pi / 2 * (levels / 255) ** camera.exponent) ** 2

    def flash(self, before: int, after: int, delay: float) -> np.ndarray:
        """Weight of each row during a flash, ``delay`` slots after the change."""
        camera = self.camera
        rows = (np.arange(camera.panel[0]) + 0.5) / camera.panel[0]
        since_s = (delay + FLASH * (np.arange(200) + 0.5) / 200) * SLOT_S
        since_s = since_s - (camera.delay_s + camera.scan_s * rows)[:, None]
        start, end = math.pi * (np.array([before, after]) / 255) ** camera.exponent
        tau_s = camera.tau_on_s if end > start else camera.tau_off_s
        turned = end + (start - end) * np.exp(-np.maximum(since_s, 0) / tau_s)
        light = np.sin(np.where(since_s < 0, start, turned) / 2) ** 2
        return camera.leak + (1 - camera.leak) * light.mean(axis=1)


WELL_E = 7000.0  # of a CCD pixel in the brightest flat


def bench(camera: Camera, seed: int, clock: float = 0.0) -> dict[str, Any]:
    """Return the manifest of a bench, with frames in place of the names of files.

    ``clock`` is an error of the stated delay of every flash, slots.
    """
    lab = Laboratory(camera, seed)
    rows, cols = camera.panel
    unit = WELL_E * np.ones(camera.panel)

    def flat(level: int, irradiance: float, n_frames: int) -> dict[str, Any]:
        frames = lab.image(unit * irradiance * lab.weight(np.full(camera.panel, level)), n_frames)
        return {"level": level, "irradiance_w_m2": irradiance, "files": frames}

    def patches(v: range, u: range, size: int, n_frames: int) -> dict[str, Any]:
        levels = np.zeros(camera.panel)
        for row in v:
            for col in u:
                levels[row : row + size, col : col + size] = 255
        frames = lab.image(unit * lab.weight(levels), n_frames)
        return {"rows": [*v], "cols": [*u], "size": size, "irradiance_w_m2": 1.0, "files": frames}

    def single(v: int, u: int, size: int, n_frames: int) -> dict[str, Any]:
        return patches(range(v, v + 1), range(u, u + 1), size, n_frames)

    def step(before: int, after: int, delay: float) -> dict[str, Any]:
        frames = lab.image(unit * lab.flash(before, after, delay)[:, None], 1)
        times = {"delay_s": (delay + clock) * SLOT_S, "flash_s": FLASH * SLOT_S}
        return {"before": before, "after": after, **times, "files": frames}

    return {
        "format": "optsim bench 3",
        "slot_s": SLOT_S,
        "slots_per_frame": SLOTS,
        "coded_slots": SLOTS,
        "panel_shape": [rows, cols],
        "white_rad": math.pi,
        "orientation": ["down", "right"],
        "about": {"program": "second_program.py", "seed": seed},
        "darks": lab.image(0 * unit, 8),
        "flats": [flat(255, light, 3) for light in (0.4, 0.7, 1.0)],
        "off": flat(0, 10.0, 3),
        "greys": [flat(level, 1.0, 2) for level in (96, 160, 208)],
        "saturated": flat(255, 8.0, 2),
        "anchors": [single(v, u, 3, 1) for v, u in ((12, 16), (12, 48), (36, 16))],
        "dots": [
            patches(range(v, rows - 3, 10), range(u, cols - 3, 10), 1, 2) for v in (3, 8) for u in (3, 8)
        ],
        "glare": [single(v, u, rows // 2, 3) for v, u in ((0, 0), (rows // 2, cols - rows // 2))],
        "steps": [step(*ends, delay) for ends in ((0, 255), (255, 0)) for delay in DELAYS],
        "fields": [],
    }


def write_png(path: Path, image: np.ndarray) -> None:
    """Write 16-bit greyscale PNG: header, one block of pixels without filters, end."""

    def chunk(name: bytes, content: bytes) -> bytes:
        body = name + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    lines = np.zeros((len(image), 1 + 2 * image.shape[1]), np.uint8)
    lines[:, 1:] = image.astype(">u2").view(np.uint8).reshape(len(image), -1)
    head = struct.pack(">IIBBBBB", image.shape[1], len(image), 16, 0, 0, 0, 0)
    packed = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(lines.tobytes(), 1)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + packed)


def write(folder: Path, manifest: dict[str, Any]) -> None:
    """Write the images and the manifest."""
    folder.mkdir(parents=True, exist_ok=True)

    def named(stem: str, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            names = [f"{stem}_{k}.png" for k in range(len(value))]
            for name, image in zip(names, value, strict=True):
                write_png(folder / name, image)
            return names
        if isinstance(value, dict):
            return {
                key: named(f"{stem}_{key}" if key != "files" else stem, each) for key, each in value.items()
            }
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return [named(f"{stem}{k}", each) for k, each in enumerate(value)]
        return value

    record = {key: named(key, value) for key, value in manifest.items()}
    (folder / "bench.json").write_text(json.dumps(record, indent=1))


MISALIGNED = replace(
    Camera(),
    shift=(1.7, -2.2),
    rotation=3e-3,
    magnification=0.99,
    tilt=4e-3,
    barrel=-5e-3,
    blur=1.0,
)

if __name__ == "__main__":
    write(Path(sys.argv[1]), bench(MISALIGNED, seed=20))
