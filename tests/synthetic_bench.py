"""A camera in plain numpy for the tests of the calibration: it shares no code with what it tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import erf

from optsim.calibration import Bench, Flat, Patches, Step


def _smooth_box(x: np.ndarray, width: float, sigma: float) -> np.ndarray:
    """Integral from -infinity to x of a unit box of some width blurred by a Gaussian."""

    def ramp(z: np.ndarray) -> np.ndarray:  # integral of the Gaussian's cumulative
        return z / 2 * (1 + erf(z / sigma / np.sqrt(2))) + sigma / np.sqrt(2 * np.pi) * np.exp(
            -((z / sigma) ** 2) / 2
        )

    return (ramp(x + width / 2) - ramp(x - width / 2)) / width


@dataclass
class Camera:
    panel: tuple[int, int] = (48, 64)
    ccd: tuple[int, int] = (160, 208)
    ratio: float = 2.88
    shift: tuple[float, float] = (3.3, -2.7)
    rotation: float = 0.01
    magnification: float = 1.003
    distortion: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None
    mirrored: bool = False
    blur: float = 0.9  # sigma, CCD pixels
    leak: float = 0.01
    tau_on_s: float = 0.5e-3
    tau_off_s: float = 1.0e-3
    exponent: float = 1.2
    slot_s: float = 1 / 180
    slots: int = 36
    dn_per_e: float = 0.7
    read_e: float = 9.4
    full_well_e: float = 15770.0
    black: float = 200.0
    veil: float = 0.0
    dead_ccd: Sequence[tuple[int, int]] = field(default_factory=list)
    stuck: Sequence[tuple[int, int, float]] = field(default_factory=list)
    electrons_per_w: float = 12600.0 / 36  # electrons per slot at 1 W m^-2, centre, all on

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(7)
        self.fixed_black = self.black + self.rng.normal(0, 1.5, self.ccd)
        y, x = np.indices(self.ccd)
        radius = np.hypot((y - self.ccd[0] / 2) / self.ccd[0], (x - self.ccd[1] / 2) / self.ccd[1])
        self.response = (1 - 0.5 * radius**2) * (1 + self.rng.normal(0, 0.008, self.ccd))
        for place in self.dead_ccd:
            self.response[place] = 0
        self.relay = self._relay()

    def place(self, panel: np.ndarray) -> np.ndarray:
        """CCD coordinates of panel coordinates, (..., 2)."""
        p = (panel - np.array(self.panel) / 2) * self.ratio * self.magnification
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        y, x = c * p[..., 0] + s * p[..., 1], -s * p[..., 0] + c * p[..., 1]
        if self.mirrored:
            x = -x
        if self.distortion is not None:
            dy, dx = self.distortion(y, x)
            y, x = y + dy, x + dx
        return np.stack([y + self.ccd[0] / 2 + self.shift[0], x + self.ccd[1] / 2 + self.shift[1]], axis=-1)

    def _relay(self) -> csr_matrix:
        centres = self.place(np.indices(self.panel).reshape(2, -1).T + 0.5)
        span = np.arange(-7, 8)
        side = self.ratio * self.magnification
        shares, pixels = [], []
        for axis in (0, 1):
            edge = np.floor(centres[:, axis]).astype(int)[:, None] + span
            at = edge - centres[:, axis][:, None]
            shares.append(_smooth_box(at + 1.0, side, self.blur) - _smooth_box(at, side, self.blur))
            pixels.append(edge)
        share = (shares[0][:, :, None] * shares[1][:, None, :]).ravel()
        row = np.broadcast_to(pixels[0][:, :, None], (len(centres), 15, 15)).ravel()
        col = np.broadcast_to(pixels[1][:, None, :], (len(centres), 15, 15)).ravel()
        source = np.repeat(np.arange(len(centres)), 225)
        on = (row >= 0) & (row < self.ccd[0]) & (col >= 0) & (col < self.ccd[1])
        size = self.ccd[0] * self.ccd[1]
        return csr_matrix(
            (share[on] * side**2, (row[on] * self.ccd[1] + col[on], source[on])), (size, len(centres))
        )

    def weight(self, levels: np.ndarray) -> np.ndarray:
        w = self.leak + (1 - self.leak) * np.sin(np.pi / 2 * (levels / 255) ** self.exponent) ** 2
        for v, u, value in self.stuck:
            w[v, u] = value
        return w

    def electrons(self, weight_slots: np.ndarray, irradiance: float) -> np.ndarray:
        """Mean electrons on the CCD from the sum over slots of weight x irradiance."""
        image = (self.relay @ weight_slots.ravel()).reshape(self.ccd)
        image = (1 - self.veil) * image + self.veil * image.mean()
        return image * self.response * irradiance * self.electrons_per_w

    def frames(self, mean_e: np.ndarray, n: int) -> np.ndarray:
        e = np.minimum(self.rng.poisson(mean_e, (n, *self.ccd)), self.full_well_e)
        e = e + self.rng.normal(0, self.read_e, e.shape)
        return np.clip(np.round(e * self.dn_per_e + self.fixed_black), 0, 16383 * 4).astype(np.uint16)

    def held(self, levels: np.ndarray, irradiance: float, n: int) -> np.ndarray:
        return self.frames(self.electrons(self.weight(levels) * self.slots, irradiance), n)

    def flat(self, level: int, irradiance: float, n: int) -> Flat:
        return Flat(level, irradiance, self.held(np.full(self.panel, level), irradiance, n))

    def patches(self, rows: Sequence[int], cols: Sequence[int], size: int) -> Patches:
        pattern = Patches(tuple(rows), tuple(cols), size, 1.0, np.zeros((1, 1, 1), np.uint16))
        return Patches(pattern.rows, pattern.cols, size, 1.0, self.held(pattern.levels(self.panel), 1.0, 2))

    def step(self, before: int, after: int, delay_slots: float) -> Step:
        """Flash of a tenth of a slot; the panel is followed in 400 small steps."""
        t = (delay_slots + (np.arange(400) + 0.5) / 4000) * self.slot_s
        start, end = np.pi * (np.array([before, after]) / 255) ** self.exponent
        tau = self.tau_on_s if end > start else self.tau_off_s
        gamma = np.where(t < 0, start, end + (start - end) * np.exp(-np.maximum(t, 0) / tau))
        w = self.leak + (1 - self.leak) * np.mean(np.sin(gamma / 2) ** 2)
        dn = self.frames(self.electrons(np.full(self.panel, w * self.slots), 1.0), 1)
        return Step(before, after, delay_slots * self.slot_s, 0.1 * self.slot_s, dn)

    def bench(self) -> Bench:
        v, u = self.panel
        delays = np.arange(-5, 21) / 10
        return Bench(
            slot_s=self.slot_s,
            slots_per_frame=self.slots,
            coded_slots=self.slots,
            panel_shape=self.panel,
            ccd_pitch_m=4e-6,
            ccd_per_panel_px=self.ratio,
            darks=self.frames(np.zeros(self.ccd), 16),
            flats=tuple(self.flat(255, e, 8) for e in (0.3, 0.6, 1.0)),
            off=self.flat(0, 10.0, 4),
            greys=tuple(self.flat(g, 1.0, 1) for g in (96, 160)),
            saturated=self.flat(255, 6.0, 4),
            anchors=tuple(
                self.patches([r], [c], 3)
                for r, c in ((v // 4, u // 4), (v // 4, 3 * u // 4), (3 * v // 4, u // 4))
            ),
            dots=tuple(
                self.patches(range(3 + i, v - 1, 10), range(3 + j, u - 1, 10), 1)
                for i in (0, 5)
                for j in (0, 5)
            ),
            glare=tuple(self.patches([r], [c], v // 2) for r, c in ((0, 0), (v - v // 2, u - v // 2))),
            steps=tuple(self.step(*ends, d) for ends in ((0, 255), (255, 0)) for d in delays),
        )
