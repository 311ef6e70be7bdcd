"""The coded-exposure camera: a frozen chain of parts that turns radiance and codes into coded frames."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from pydantic import Field, model_validator

from optsim.camera.geometry import GeometryReport, LatencyReport, geometry_report, latency_report
from optsim.camera.ledger import LedgerRow, photon_ledger
from optsim.camera.parts import AnyCcd, AnyModulator, AnyObjective, AnyRelay, AnySplitter, chain, form_image
from optsim.core.config import Part
from optsim.core.errors import ConfigError, ValueCheckError
from optsim.core.quantities import (
    Bools,
    Bytes,
    CodedFrame,
    Doubles,
    ExposureCode,
    Floats,
    IrradianceVideo,
    PanelState,
    RadianceVideo,
    Timing,
    Video,
    View,
)
from optsim.optics.fringing import border_shares, whole_cells
from optsim.optics.integrate import Shutter, integrate_exposure, slot_means
from optsim.optics.panel import PanelResponse, first_panel, settled_panel, slot_weights, switched
from optsim.optics.radiometry import MONO_WAVELENGTH_M, photons_per_joule
from optsim.optics.relay import RelayGeometry, RelayOperator

SAMPLES_PER_PITCH = 3


class CodedCamera(Part):
    """Objective, splitter, panel, relay and CCD, with their true parameters.

    Parameters
    ----------
    objective, splitter, modulator, relay, sensor
        The parts, with their true numbers; ``hardware`` of the ``[camera]`` table gives the defaults.
    panel_rows, panel_cols : int
        Panel pixels used, around the centre of the panel.
    slots_per_frame : int
        Slots in the period of coded frames; a slot lasts 1 / modulator.field_rate_hz.
    latency_frames : int
        Code f may use frames up to f - latency_frames. The paper's prototype has 3.
    overlap : bool
        Whether the CCD is read out during the next exposure. If not, the last slots of each period are
        uncoded, panel black and shutter closed, for as long as the readout takes.
    serial_number : int
        Seed of this camera's fixed patterns.
    wavelength_m : float
        Wavelength of the light, m; a scene with a band sets it.
    """

    objective: AnyObjective
    splitter: AnySplitter
    modulator: AnyModulator
    relay: AnyRelay
    sensor: AnyCcd
    panel_rows: int = Field(ge=1)
    panel_cols: int = Field(ge=1)
    slots_per_frame: int = Field(default=36, ge=1)
    latency_frames: int = Field(default=3, ge=1)
    overlap: bool = True
    serial_number: int = Field(default=1, ge=0)
    wavelength_m: float = Field(default=MONO_WAVELENGTH_M, ge=1e-7, le=1e-4)

    @model_validator(mode="after")
    def _parts_work_together(self) -> CodedCamera:
        if self.coded_slots < 1:
            raise ValueError(
                f"slots_per_frame: got {self.slots_per_frame}, expected more than the "
                f"{self.slots_per_frame - self.coded_slots} slots that without overlap the readout takes, "
                f"{self.sensor.frame_readout_s * 1e3:.3g} ms; raise it, or set overlap = true"
            )
        self.splitter.check_band(self.wavelength_m)
        self.sensor.efficiency_at(self.wavelength_m)
        f_number = self.objective.working_f_number
        chain.check_contrast(self.splitter, self.modulator, f_number, self.wavelength_m)
        return self

    # -- what it is ---------------------------------------------------------------------------------------

    @property
    def view(self) -> View:
        """Fine grid on which scenes are rendered for this camera, and the lens before it."""
        lens, half_width_m = self.objective, self.panel_cols * self.modulator.pitch_m / 2
        return View(
            rows=self.panel_rows * SAMPLES_PER_PITCH,
            cols=self.panel_cols * SAMPLES_PER_PITCH,
            samples_per_pitch=SAMPLES_PER_PITCH,
            tan_half_width=half_width_m * lens.tan_per_metre(),
            aperture_m=0.0 if lens.focus_m == "everywhere" else lens.aperture_m,
            focus_m=None if isinstance(lens.focus_m, str) else lens.focus_m,
            defocus_per_m=lens.defocus_per_m,
            distortion=lens.distortion,
        )

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the light, nm."""
        return round(self.wavelength_m * 1e9, 6)

    @property
    def slot_s(self) -> float:
        """Duration of a slot, s."""
        return 1 / self.modulator.field_rate_hz

    @property
    def coded_slots(self) -> int:
        """Whole slots of a period in which the shutter is open; the readout takes the rest."""
        if self.overlap:
            return self.slots_per_frame
        return self.slots_per_frame - int(np.ceil(self.sensor.frame_readout_s / self.slot_s - 1e-9))

    @property
    def exposure_s(self) -> float:
        """Time for which the shutter is open, s."""
        return self.coded_slots * self.slot_s

    @property
    def contrast(self) -> float:
        """Transmission of splitter, polarisers and panel fully on over fully off, on axis: an output.

        Infinite for parts without leak.
        """
        dark = self._leaks(np.zeros(1))[0]
        return 1 / float(dark) if dark > 0 else float("inf")

    @property
    def panel_response(self) -> PanelResponse:
        """True response of the panel between its polarisers, with the leak on axis."""
        # Without contrast, rounding may give slightly more than 1.
        return self.modulator.response(
            min(float(self._leaks(np.zeros(1))[0]), 1.0), self.panel_rows, self.wavelength_m
        )

    @property
    def irradiance_per_radiance(self) -> float:
        """Modulator irradiance on axis per radiance, W m^-2 per W m^-2 sr^-1, glare left out."""
        return self.objective.irradiance_per_radiance

    @property
    def ratio(self) -> float:
        """CCD pixels per panel pixel."""
        return self.modulator.pitch_m * self.relay.magnification / self.sensor.pitch_m

    def timing(self, n_frames: int) -> Timing:
        """Slots and frames of an experiment."""
        return Timing(self.slot_s, self.slots_per_frame, n_frames)

    def with_nd(self, transmission: float) -> CodedCamera:
        """Return the same camera behind another neutral density.

        Raises
        ------
        ConfigError
            For a transmission outside 0..1.
        """
        if not 0 < transmission <= 1:
            raise ConfigError(
                f"camera.objective.nd_transmission: got {transmission:g}, expected more than 0 and at most 1"
            )
        objective = self.objective.model_copy(update={"nd_transmission": transmission})
        return self.model_copy(update={"objective": objective})

    def without_glare(self) -> CodedCamera:
        """Return the same camera without veiling glare in objective and relay."""
        objective = self.objective.model_copy(update={"glare_share": 0.0})
        relay = self.relay.model_copy(update={"glare_share": 0.0})
        return self.model_copy(update={"objective": objective, "relay": relay})

    # -- what it does -------------------------------------------------------------------------------------

    def form_image(self, radiance: RadianceVideo) -> IrradianceVideo:
        """Irradiance on the modulator; lazy, with the segments of the last coded frame kept.

        Raises
        ------
        ValueCheckError
            When the video is of another panel or slot.
        """
        self._check(radiance)
        kept = max(2, self.slots_per_frame // radiance.slots_per_segment)
        return form_image(self.objective, radiance, self.modulator.pitch_m, kept, self.wavelength_m)

    def panel_at_rest(self) -> PanelState:
        """State of a panel that has been dark for long."""
        return settled_panel(np.zeros((self.panel_rows, self.panel_cols), np.uint8), self.panel_response)

    def expose(
        self,
        truth: IrradianceVideo,
        index: int,
        code: ExposureCode,
        panel: PanelState | None,
        rng: Generator,
    ) -> tuple[CodedFrame, PanelState]:
        """Take one coded frame.

        Parameters
        ----------
        truth : IrradianceVideo
            Light on the modulator.
        index : int
            Coded frame; it starts at slot ``index * slots_per_frame``.
        code : ExposureCode
            Commanded code, all slots of the period.
        panel : PanelState or None
            The panel when the frame begins. None at the start of an experiment: it has then shown a cycle of
            this code.
        rng : Generator
            Generator of this frame's shot and read noise.

        Returns
        -------
        frame : CodedFrame
            The raw frame with its code.
        panel : PanelState
            The panel when the next frame begins.

        Raises
        ------
        ValueCheckError
            When code or truth are of another panel, slot or number of slots.
        """
        expected, after = self.expected_electrons(truth, index, code, panel)
        dn, negative_light = self.sensor.digitise(expected, self.exposure_s, self.serial_number, rng)
        return CodedFrame(index, dn, code, negative_light), after

    def expected_electrons(
        self, truth: IrradianceVideo, index: int, code: ExposureCode, panel: PanelState | None
    ) -> tuple[Doubles, PanelState]:
        """Compute the mean electrons of a frame before any clip, (y, x); arguments as in :meth:`expose`."""
        self._check(truth)
        shutter, after = self.shutter(code, panel, truth.instants_per_slot, truth.samples_per_pitch)
        energy = self.panel_energy(truth, index, shutter)
        return self.electrons_of(self.relay_operator(truth.samples_per_pitch).apply(energy)), after

    def shutter(
        self, code: ExposureCode, panel: PanelState | None, n_sub: int, pitch: int = SAMPLES_PER_PITCH
    ) -> tuple[Shutter, PanelState]:
        """Return the transmission of the panel in a frame, fully on as 1, and the panel after it."""
        levels, panel, response = self._drive(code, panel)
        answer = response, self.slot_s, n_sub, self.column_leaks
        weights, after = slot_weights(levels, panel, *answer)
        weights[self.coded_slots * n_sub :] = 0
        driven, begin = switched(levels, panel, response)
        fringe = self.modulator.fringe_correction(driven[: self.coded_slots], begin, *answer, pitch)
        return Shutter(weights, border_shares(self.modulator.fringing_px, pitch), fringe), after

    def panel_energy(self, truth: IrradianceVideo, index: int, shutter: Shutter) -> Floats:
        """Radiant exposure that leaves the panel toward the relay, fine grid, J m^-2."""
        energy = integrate_exposure(truth, index * self.slots_per_frame, shutter)
        return energy * whole_cells(self.panel_gain, truth.samples_per_pitch)

    def electrons_of(self, image: Doubles) -> Doubles:
        """Mean electrons of a radiant exposure of the CCD, dark electrons included, (y, x)."""
        return self.photon_electrons(image) + self.dark_e

    def reference(self, truth: IrradianceVideo, index: int) -> Floats:
        """Return a perfect decoder's answer, (slot, v, u), W m^-2: means over pitch cells without shading."""
        means = slot_means(truth, index * self.slots_per_frame, self.slots_per_frame)
        return means / truth.shading

    def relay_operator(self, samples_per_pitch: int = SAMPLES_PER_PITCH) -> RelayOperator:
        """Return the true operator from the fine grid behind the panel to radiant exposure on the CCD."""
        panel_f_number = self.objective.working_f_number
        transmission = self.relay.transmission * self.relay.accepted_share(panel_f_number)
        return self.relay.operator(
            self.relay_geometry(samples_per_pitch),
            panel_f_number,
            self.modulator.pitch_m / samples_per_pitch,
            transmission,
            samples_per_pitch,
            self.wavelength_m,
        )

    # -- what one knows before building it ----------------------------------------------------------------

    def ledger(self, radiance_w_m2_sr: float) -> tuple[LedgerRow, ...]:
        """Photon ledger of a uniform radiance on axis, all-on."""
        return photon_ledger(
            radiance_w_m2_sr,
            objective=self.objective,
            splitter=self.splitter,
            modulator=self.modulator,
            relay=self.relay,
            sensor=self.sensor,
            coded_slots=self.coded_slots,
            wavelength_m=self.wavelength_m,
        )

    def geometry(self) -> GeometryReport:
        """Whether and how the panel's image fits the CCD; raises nothing."""
        return geometry_report(
            panel=(self.panel_rows, self.panel_cols),
            modulator=(self.modulator.rows, self.modulator.cols),
            ccd=(self.sensor.rows, self.sensor.cols),
            ratio=self.ratio,
            extent_px=self.relay_geometry().extent(),
            relay_accepts=self.relay.accepted_share(self.objective.working_f_number),
        )

    def smallest_latency_frames(self, computation_s: float = 0.05) -> LatencyReport:
        """Smallest physical latency; the time for computing masks and codes is an assumption."""
        return latency_report(
            readout_s=self.sensor.frame_readout_s,
            ccd_pixels=self.sensor.rows * self.sensor.cols,
            computation_s=computation_s,
            period_s=self.slots_per_frame * self.slot_s,
            slack_s=(self.slots_per_frame - self.coded_slots) * self.slot_s,
        )

    # -- small shared pieces ------------------------------------------------------------------------------

    def _check(self, video: Video) -> None:
        panel = (self.panel_rows, self.panel_cols)
        if video.panel_shape != panel or abs(video.slot_s / self.slot_s - 1) > 1e-6:
            raise ValueCheckError(
                f"video of panel {video.panel_shape} and slots of {video.slot_s * 1e3:.4g} ms: this camera "
                f"has {panel} panel pixels (camera.panel_rows, camera.panel_cols) and slots of "
                f"{self.slot_s * 1e3:.4g} ms (camera.modulator.field_rate_hz)"
            )

    def panel_weights(
        self, code: ExposureCode, panel: PanelState | None, n_sub: int
    ) -> tuple[Floats, PanelState]:
        """Effective weights of a code's instants, (t, v, u), panel all on as 1, and the panel after it.

        Stuck pixels and uncoded slots differ from the commanded code. The weights ignore the shutter.
        """
        return slot_weights(*self._drive(code, panel), self.slot_s, n_sub, self.column_leaks)

    def _drive(self, code: ExposureCode, panel: PanelState | None) -> tuple[Bytes, PanelState, PanelResponse]:
        """Levels that drive the panel, the panel before, and its response in this frame."""
        expected = (self.slots_per_frame, self.panel_rows, self.panel_cols)
        if code.levels.shape != expected:
            raise ValueCheckError(f"code: got levels of shape {code.levels.shape}, expected {expected}")
        stuck, stuck_levels = self.stuck_pixels
        levels = code.levels.copy()
        levels[self.coded_slots :] = 0
        levels[:, stuck] = stuck_levels[stuck]
        late_s = self.modulator.lateness_s(panel.slots_displayed if panel else 0, self.serial_number)
        response = self.panel_response
        response = response.model_copy(update={"delay_s": response.delay_s + late_s})
        return levels, panel or first_panel(levels, response, self.slot_s), response

    @property
    def panel_gain(self) -> Floats:
        """Transmission of splitter and panel fully on, (v, u)."""
        pattern = self.modulator.gain(self.panel_rows, self.panel_cols, self.serial_number)
        white_rad, f_number = self.modulator.white_rad(self.wavelength_m), self.objective.working_f_number
        where = f_number, self._column_places_m, self.wavelength_m
        on = chain.throughput(self.splitter, self.modulator, white_rad, *where)
        return pattern * on.astype(np.float32)

    @property
    def column_leaks(self) -> Doubles:
        """Transmission fully off over fully on of each panel column, (u,)."""
        return self._leaks(self._column_places_m)

    def _leaks(self, x_m: Doubles) -> Doubles:
        f_number = self.objective.working_f_number
        return chain.leak(self.splitter, self.modulator, f_number, x_m, self.wavelength_m)

    @property
    def _column_places_m(self) -> Doubles:
        column = np.arange(self.panel_cols, dtype=np.float64) + 0.5
        return (column - self.panel_cols / 2) * self.modulator.pitch_m

    @property
    def stuck_pixels(self) -> tuple[Bools, Bytes]:
        """Stuck panel pixels, (v, u), and the level of each."""
        return self.modulator.stuck(self.panel_rows, self.panel_cols, self.serial_number)

    @property
    def dark_e(self) -> float:
        """Dark signal of a frame, electrons."""
        return self.sensor.dark_rate_e_s * self.exposure_s

    def photon_electrons(self, energy_j_m2: Doubles) -> Doubles:
        """Mean electrons of a radiant exposure of the CCD, (y, x)."""
        per_j_m2 = self.sensor.pixel_area_m2 * photons_per_joule(self.wavelength_m)
        per_j_m2 *= self.sensor.efficiency_at(self.wavelength_m)
        return energy_j_m2 * (per_j_m2 * self.sensor.pixel_response(self.serial_number))

    def relay_geometry(self, samples_per_pitch: int = SAMPLES_PER_PITCH) -> RelayGeometry:
        """Geometry of the fine grid's image on the CCD."""
        return self.relay.geometry(
            cells=(self.panel_rows * samples_per_pitch, self.panel_cols * samples_per_pitch),
            ccd=(self.sensor.rows, self.sensor.cols),
            cell_px=self.ratio / samples_per_pitch,
            ccd_pitch_m=self.sensor.pitch_m,
            wavelength_m=self.wavelength_m,
        )
