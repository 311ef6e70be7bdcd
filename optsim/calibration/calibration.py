"""The calibration: the bench's estimate of a camera, and the only one that schemes and decoders see."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import ClassVar, Literal

import numpy as np

from optsim.calibration.glare import NO_GLARE, Glare
from optsim.core.compiled import compiled
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, CodedFrame, ExposureCode, Floats, Ints, PanelState, checked
from optsim.core.threads import in_bands
from optsim.optics.panel import PanelResponse, settled_panel, slot_weights
from optsim.optics.readings import brightest, mean_reading

# For smaller images starting threads takes longer than the work.
_FEW_PIXELS = 100_000


@dataclass(frozen=True, eq=False)
class Observation:
    """One coded frame on the panel grid, as an estimate with its error.

    Parameters
    ----------
    signal : ndarray of shape (v, u), float32
        Estimate of ``crosstalk (*) sum_slot weight E``, W m^-2 slots; slightly negative where dark.
    variance : ndarray of shape (v, u), float32
        Variance of ``signal`` by shot and read noise, its unit squared.
    saturated : ndarray of shape (v, u), bool
        A raw DN at or above the measured threshold: ``signal`` is a lower bound.
    valid : ndarray of shape (v, u), bool
        False where there is no measurement; ``signal`` and ``variance`` are finite but mean nothing there.
    """

    UNIT: ClassVar[str] = "W m^-2 slots"
    signal: Floats
    variance: Floats
    saturated: Bools
    valid: Bools


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera as measured on the bench, on the panel grid.

    A frame measures :meth:`mix` of ``light = sum over slots of weight x irradiance``. The weights are those
    of each panel pixel alone. The crosstalk kernel adds shares of the neighbours' light, and glare adds light
    from farther away. The readout window is the CCD pixel at a panel pixel's centre, or the mean of a square
    around it. Beyond the panel's edge the nearest pixel's value is used, so uniform light stays uniform.

    Parameters
    ----------
    source : {"bench", "true", "ideal"}
        Measured, copied from the camera, or the paper's equations.
    slot_s : float
        Duration of a slot, s.
    slots_per_frame, coded_slots : int
        Slots in a frame's period, and those at its start in which the shutter is open.
    ccd_shape : tuple of int
        CCD pixels (rows, columns) of a frame.
    response : PanelResponse
        Temporal response, contrast and grey curve of the panel.
    centre_row, centre_col : ndarray of shape (v, u), int64
        Pixel map: CCD row and column at the centre of each panel pixel. They lie on the CCD even where not
        valid.
    valid : ndarray of shape (v, u), bool
        False: off the CCD, a dead CCD pixel, a stuck panel pixel.
    responsivity_dn : ndarray of shape (v, u), float32
        DN per (W m^-2 on axis) per slot at weight 1. It is the product of every shading (objective, splitter,
        panel, relay, CCD pixel): a flat cannot separate them. Positive everywhere; without meaning where not
        valid.
    black_dn, saturation_dn : ndarray of shape (v, u), float32
        Black level of the readout window, and the raw DN from which a CCD pixel in it is saturated.
    read_noise_dn : float
        Temporal noise of the readout window in the dark, quantisation included, DN.
    dn_per_e : float
        System gain of the readout window: DN per electron, divided by the number of CCD pixels averaged.
    crosstalk : ndarray of shape (v, u, k, k), float32
        Crosstalk kernels. Element (k // 2 + dv, k // 2 + du) is the share of the light of pixel (v + dv, u +
        du) in the reading of (v, u). k is odd, each kernel sums to 1.
    gain_uncertainty, leak_uncertainty : float
        Relative standard uncertainty, pixel to pixel, of the responsivity and of the leak.
    map_residual_px : float
        Rms distance between the fitted map and the measured dots, panel pixels.
    glare : Glare
        Shares of the light that land beyond the kernel: PSF tails, a ghost, veiling glare.
    reading_px : int
        Side of the readout window, CCD pixels, odd.
    standard_errors : mapping
        Standard errors of single numbers by their names in the calibration's file, in the same unit, and
        ``map_px`` of the pixel map, panel pixels; of measured ones only.
    misalignment : mapping
        Shift, rotation, scale, keystone and distortion of the panel's image by the names of
        :data:`~optsim.calibration.misalignment.NAMES`; their errors stand in ``standard_errors``.
    """

    source: Literal["bench", "true", "ideal"]
    slot_s: float
    slots_per_frame: int
    coded_slots: int
    ccd_shape: tuple[int, int]
    response: PanelResponse
    centre_row: Ints
    centre_col: Ints
    valid: Bools
    responsivity_dn: Floats
    black_dn: Floats
    saturation_dn: Floats
    read_noise_dn: float
    dn_per_e: float
    crosstalk: Floats
    gain_uncertainty: float
    leak_uncertainty: float
    map_residual_px: float
    glare: Glare = NO_GLARE
    reading_px: int = 1
    standard_errors: Mapping[str, float] = field(default_factory=dict[str, float])
    misalignment: Mapping[str, float] = field(default_factory=dict[str, float])

    def __post_init__(self) -> None:
        for name, dtype, unit in (
            ("centre_row", np.int64, "CCD pixel"),
            ("centre_col", np.int64, "CCD pixel"),
            ("valid", np.bool_, "mask"),
            ("responsivity_dn", np.float32, "DN / (W m^-2 slot)"),
            ("black_dn", np.float32, "DN"),
            ("saturation_dn", np.float32, "DN"),
        ):
            checked(f"calibration.{name}", getattr(self, name), axes=("v", "u"), dtype=dtype, unit=unit)
            if getattr(self, name).shape != self.valid.shape:
                raise ValueCheckError(
                    f"calibration.{name} has shape {getattr(self, name).shape}, valid has {self.valid.shape}"
                )
        self._check_numbers()
        rows, cols = self.ccd_shape
        for name, centre, size in (("row", self.centre_row, rows), ("col", self.centre_col, cols)):
            if int(centre.min()) < 0 or int(centre.max()) >= size:
                raise ValueCheckError(
                    f"calibration.centre_{name}: got CCD pixels {int(centre.min())} to {int(centre.max())}, "
                    f"expected some of the {size} of a frame of {self.ccd_shape} pixels"
                )
        if float(self.responsivity_dn.min()) <= 0:
            raise ValueCheckError("calibration.responsivity_dn: got a value <= 0, expected > 0 everywhere")
        kernel = self.crosstalk
        checked(
            "calibration.crosstalk",
            kernel,
            axes=("v", "u", "dv", "du"),
            dtype=np.float32,
            unit="1",
            nonnegative=False,
        )
        off = np.abs(kernel.sum(axis=(2, 3)) - 1).max()
        if (
            kernel.shape[:2] != self.valid.shape
            or kernel.shape[2] != kernel.shape[3]
            or kernel.shape[2] % 2 == 0
            or off > 1e-4
        ):
            raise ValueCheckError(
                f"calibration.crosstalk: got shape {kernel.shape} and sums up to {off:.3g} off 1, expected "
                f"{(*self.valid.shape, 'k', 'k')} with odd k and sums of 1"
            )

    def _check_numbers(self) -> None:
        """Refuse numbers that no camera has."""
        for name, fine, expected in (
            ("slot_s", self.slot_s > 0, "more than 0"),
            ("slots_per_frame", self.slots_per_frame >= 1, "at least 1"),
            ("coded_slots", 1 <= self.coded_slots <= self.slots_per_frame, "1 to all slots of a frame"),
            ("ccd_shape", len(self.ccd_shape) == 2, "rows and columns"),
            ("read_noise_dn", self.read_noise_dn >= 0, "at least 0"),
            ("dn_per_e", self.dn_per_e >= 0, "at least 0"),
            ("reading_px", self.reading_px >= 1 and self.reading_px % 2 == 1, "an odd number"),
        ):
            if not fine:
                raise ValueCheckError(f"calibration.{name}: got {getattr(self, name)}, expected {expected}")

    @property
    def shape(self) -> tuple[int, int]:
        """Panel pixels (v, u)."""
        rows, cols = self.valid.shape
        return rows, cols

    def panel_at_rest(self) -> PanelState:
        """State of a panel that has been dark for long."""
        return settled_panel(np.zeros(self.shape, np.uint8), self.response)

    def weights(self, code: ExposureCode, panel: PanelState | None) -> tuple[Floats, PanelState]:
        """Weight of each slot at each panel pixel by itself.

        Parameters
        ----------
        code : ExposureCode
            All slots of a frame's period.
        panel : PanelState or None
            The panel when the frame starts. None at the start of an experiment: it has then shown a cycle of
            this code.

        Returns
        -------
        weights : ndarray of shape (slot, v, u), float32
            1 for a pixel fully on for ever; 0 in slots with the shutter closed.
        panel : PanelState
            The panel when the next frame starts.

        Raises
        ------
        ValueCheckError
            When the code is of another panel or number of slots.
        """
        expected = (self.slots_per_frame, *self.shape)
        if code.levels.shape != expected:
            raise ValueCheckError(f"code: got levels of shape {code.levels.shape}, expected {expected}")
        weights, after = slot_weights(code.levels, panel, self.response, self.slot_s)
        weights[self.coded_slots :] = 0
        return weights, after

    def effective_weights(self, code: ExposureCode, panel: PanelState | None) -> tuple[Floats, PanelState]:
        """Weights with the neighbours' share added: the diagonal approximation of the whole operator.

        Exact where the irradiance is uniform over the reach of the crosstalk. Arguments and results as in
        :meth:`weights`.
        """
        weights, panel = self.weights(code, panel)
        return self.spread(weights), panel

    def mix(self, light: Floats) -> Floats:
        """Mix each pixel's own light as a frame does, by crosstalk and glare: array (v, u), float32.

        Parameters
        ----------
        light : ndarray of shape (v, u), float32
            Sum over slots of weight x irradiance, W m^-2 slots.
        """
        return self.mix_near(light) + self.mix_far(light)

    def mix_adjoint(self, signal: Floats) -> Floats:
        """Transpose of :meth:`mix`: array (v, u), float32."""
        rows, cols = self.shape
        reach = self.reach
        near = signal if self._glareless else self.direct_share * signal
        padded = np.zeros((rows + 2 * reach, cols + 2 * reach), np.float32)
        for i, j in np.ndindex(self._planes.shape[:2]):
            padded[i : i + rows, j : j + cols] += self._planes[i, j] * near
        if reach:
            # Beyond its edge the panel continues with its last pixels.
            for edges in (padded, padded.T):
                edges[reach] += edges[:reach].sum(axis=0)
                edges[-reach - 1] += edges[-reach:].sum(axis=0)
        light = padded[reach : reach + rows, reach : reach + cols]
        if self._glareless:
            return light
        # Glare is symmetric in the unit of the CCD.
        stray = self.glare.light(signal / self.responsivity_dn, self.reach)
        return (light + stray * self.responsivity_dn).astype(np.float32)

    def mix_near(self, light: Floats) -> Floats:
        """Compute the part of :meth:`mix` from the crosstalk kernel."""
        near = self.spread(light[None])[0]
        return near if self._glareless else self.direct_share * near

    def mix_far(self, light: Floats) -> Floats:
        """Compute the part of :meth:`mix` from glare: a few percent of bright light, smooth."""
        return np.zeros_like(light) if self._glareless else self._glare(light)

    def _glare(self, light: Floats) -> Floats:
        arrived = light * self.responsivity_dn
        return (self.glare.light(arrived, self.reach) / self.responsivity_dn).astype(np.float32)

    @cached_property
    def direct_share(self) -> Floats:
        """Share of a flat's signal that is not glare, (v, u); the responsivity includes both."""
        flat = np.ones(self.shape, np.float32)
        return flat if self._glareless else 1 - self._glare(flat)

    @cached_property
    def _glareless(self) -> bool:
        return self.glare.share(self.reach) == 0

    def spread(self, stack: Floats) -> Floats:
        """Add the neighbours' light by the crosstalk kernels: images of shape (n, v, u), float32."""
        return self._gather(stack, self._planes)

    def spread_variance(self, variance: Floats) -> Floats:
        """Add the neighbours' independent noise by the squared kernels, without the own pixel's: (v, u)."""
        return self._gather(variance[None], self._squared_planes)[0]

    @property
    def own_share(self) -> Floats:
        """Share of its own light that each pixel keeps: the centres of the kernels, array (v, u)."""
        return self.crosstalk[:, :, self.reach, self.reach]

    @property
    def ratio(self) -> float:
        """CCD pixels per panel pixel along a row or column, from the pixel map."""
        rows, cols = self.shape
        apart = (float(centre[-1, -1] - centre[0, 0]) for centre in (self.centre_row, self.centre_col))
        return max(math.hypot(*apart) / math.hypot(rows - 1, cols - 1), 1.0) if rows * cols > 1 else 1.0

    @property
    def reach(self) -> int:
        """Half width of the kernels, panel pixels."""
        return self.crosstalk.shape[2] // 2

    @cached_property
    def _planes(self) -> Floats:
        """The kernels as images, (ky, kx, v, u), so that whole rows are weighted at once."""
        return np.ascontiguousarray(self.crosstalk.transpose(2, 3, 0, 1))

    @cached_property
    def _squared_planes(self) -> Floats:
        squared = self._planes**2
        squared[squared.shape[0] // 2, squared.shape[1] // 2] = 0
        return squared

    def observe(self, frame: CodedFrame) -> Observation:
        """Bring a frame to the panel grid: subtract black, divide by the responsivity, predict the noise.

        Raises
        ------
        ValueCheckError
            When the frame is of another CCD.
        """
        if frame.dn.shape != self.ccd_shape:
            raise ValueCheckError(
                f"frame {frame.index}: got {frame.dn.shape} pixels, expected {self.ccd_shape}, those of the "
                "CCD that was calibrated; cure: whole frames, or a calibration of this CCD"
            )
        square = self.centre_row, self.centre_col, self.reading_px
        saturated = brightest(frame.dn, *square) >= self.saturation_dn
        raw: Floats = mean_reading(frame.dn, *square)
        raw -= self.black_dn
        variance = np.maximum(raw, np.float32(0))
        variance *= np.float32(self.dn_per_e)
        variance += np.float32(self.read_noise_dn**2)
        raw /= self.responsivity_dn
        variance /= self.responsivity_dn
        variance /= self.responsivity_dn
        return Observation(raw, variance, saturated, self.valid)

    def _gather(self, stack: Floats, planes: Floats) -> Floats:
        out = np.empty_like(stack)
        for image, target in zip(stack, out, strict=True):
            padded = np.pad(image, len(planes) // 2, mode="edge")
            few = _FEW_PIXELS // target.shape[1]
            in_bands(len(target), partial(_gather, padded, planes, target), few=few)
        return out


@compiled(fastmath=True)
def _gather(padded: Floats, planes: Floats, out: Floats, first: int, end: int) -> None:
    size = len(planes)
    cols = out.shape[1]
    for v in range(first, end):
        row = out[v]
        row[:] = 0
        for i in range(size):
            for j in range(size):
                share, light = planes[i, j, v], padded[v + i, j : j + cols]
                for u in range(len(row)):
                    row[u] += share[u] * light[u]
