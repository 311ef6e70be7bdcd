"""A camera that a bench measures in seconds, and uniform light through a random code for it."""

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import prototype
from optsim.core.quantities import ExposureCode, Floats, RadianceVideo, Segment


def small(**changes: object) -> CodedCamera:
    """64 x 48 panel pixels at ratio 2.9, shifted and rotated."""
    full = prototype()
    relay = full.relay.model_copy(
        update={
            "magnification": 2.9 * 4.54 / 20, "shift_y_px": 2.3, "shift_x_px": -1.8, "rotation_rad": 0.004,
        }
    )  # fmt: skip
    sensor = full.sensor.model_copy(update={"rows": 156, "cols": 204})
    modulator = full.modulator.model_copy(update={"stuck_share": 0.0})
    update = {"relay": relay, "sensor": sensor, "modulator": modulator, "panel_rows": 48, "panel_cols": 64}
    return full.model_copy(update={**update, **changes})


def uniform_light(
    camera: CodedCamera, responsivity_dn: Floats, rng: np.random.Generator
) -> tuple[ExposureCode, float, RadianceVideo]:
    """Code with half the slots open; light that fills a third of the wells: W m^-2 on the panel, video."""
    levels = (rng.random((36, 48, 64)) < 0.5).astype(np.uint8) * np.uint8(255)
    code = ExposureCode(levels, np.zeros((48, 64), np.bool_))
    # Wells of about 16400 DN.
    irradiance = 0.3 * 16400 / (18 * float(np.median(responsivity_dn)))
    view = camera.view
    image = np.full((view.rows, view.cols), irradiance / camera.irradiance_per_radiance, np.float32)
    radiance = RadianceVideo(
        view.rows, view.cols, view.samples_per_pitch, camera.slot_s, 1, 36, 36,
        lambda _: Segment(image, image, (), 36),
    )  # fmt: skip
    return code, irradiance, radiance
