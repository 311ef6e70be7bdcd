"""The camera under stress: any parts and any scene give light and whole numbers, or an error with its key."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.signal import convolve2d

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import ALL, STATES, with_effects
from optsim.camera.hardware import demo, icx674, imx174
from optsim.camera.parts import Modulator, Splitter, throughput
from optsim.camera.parts.objective import MOVING_TAIL_SHARE
from optsim.core.config import build
from optsim.core.errors import ConfigError, GeometryError
from optsim.core.quantities import Block, ExposureCode, IrradianceVideo, RadianceVideo, Segment
from optsim.optics.panel import WEIGHT_ERROR
from optsim.optics.radiometry import photons_per_joule

# What is linear and not negative may fall below zero by the rounding of transforms: of the brightest light.
ROUNDING = 1e-14
# Moving light is blurred in float32.
ROUNDING_32 = 1e-6
FLAWS = {"contrast": "pessimistic", "ghost": "ideal", "relay_glare": "ideal", "pixel_response": "ideal"}


def wide(low, high):
    """Numbers over orders of magnitude, and both ends."""
    logs = st.floats(np.log10(low), np.log10(high)).map(lambda power: float(np.clip(10**power, low, high)))
    return st.sampled_from([low, high]) | logs


def near(limit):
    return st.sampled_from([0.0, -limit, limit]) | st.floats(-limit, limit)


@st.composite
def tables(draw):
    """Resolved configuration of a camera within the limits that every field states."""
    states = draw(st.fixed_dictionaries({name: st.sampled_from(STATES) for name in ALL}))
    table = with_effects(demo(), states).model_dump()
    rows, cols = draw(st.sampled_from([1, 2, 25]) | st.integers(1, 25)), draw(st.integers(1, 31))
    ratio, f_number = draw(wide(0.3, 10)), draw(wide(0.7, 64))
    sensor = draw(st.sampled_from([icx674(), imx174()])).model_dump()
    sensor |= {
        "rows": max(1, int(np.ceil(rows * ratio)) + draw(st.integers(-2, 8))),
        "cols": max(1, int(np.ceil(cols * ratio)) + draw(st.integers(-2, 8))),
        "smear_share": draw(st.sampled_from([0.0, 1e-3, 1.0])),
        "bits": (bits := draw(st.sampled_from([8, 12, 14, 16]))),
        "gain_e": draw(wide(0.5 if bits == 8 else 0.1, 100)),  # less shows no light
    }
    table["objective"] |= {
        "f_number": f_number,
        "magnification": draw(st.floats(0.72, 3)),
        "focal_length_m": draw(wide(1e-4, 0.1)),
        "nd_transmission": draw(wide(1e-6, 1)),
    }
    table["relay"] |= {
        "magnification": ratio * sensor["pitch_m"] / table["modulator"]["pitch_m"],
        "f_number": draw(wide(3, 10)),
        "defocus_m": draw(near(3e-5)),
        "ghost_share": draw(st.sampled_from([0.0, 0.01, 0.9])),
        "ghost_blur_px": draw(wide(0.1, 200)),
        "shift_y_px": draw(st.sampled_from([0.0, 0.3, -1.0, 1e3])),
        "rotation_rad": draw(near(0.05)),
        "keystone_y": draw(near(0.2)),
        "keystone_x": draw(near(0.2)),
        "distortion": draw(near(0.2)),
    }
    for lens in ("objective", "relay"):
        # Wide windows and their aberrations take long, and more so for slow cones.
        if f_number > 16:
            table[lens]["wavefront"] = {"coma_waves": 0.05}
        table[lens]["tail_share"] = draw(wide(2e-3 if f_number < 8 else 0.02, 0.1))
        table[lens]["field_error"] = draw(wide(0.1 if f_number < 8 else 0.4, 1))
        table[lens]["glare_share"] = draw(st.sampled_from([0.0, 0.01, 0.9]))
    slots = draw(st.sampled_from([1, 2, 6, 12]))
    slot_s = 1 / table["modulator"]["field_rate_hz"]
    table["modulator"] |= {
        "tau_on_s": draw(st.just(0.0) | wide(1e-2 * slot_s, 100 * slot_s)),
        "tau_off_s": draw(st.just(0.0) | wide(1e-2 * slot_s, 100 * slot_s)),
        "temperature_c": draw(st.sampled_from([-20.0, 25.0, 90.0])),
        "nonuniformity_rms": draw(st.sampled_from([0.0, 0.2])),
        "stuck_share": draw(st.sampled_from([0.0, 0.02])),
        "depolarised_share": draw(st.sampled_from([0.0, 0.01, 1.0])),
        "fringing_px": draw(st.sampled_from([0.0, 0.25])),
    }
    table["splitter"] |= {
        "placement": draw(st.sampled_from(["collimated", "converging"])),
        "acceptance_rad": draw(wide(1e-3, 1)),
        "cleanup_contrast": draw(st.sampled_from([1.0, 1e3, 1e12])),
        "ts": (ts := draw(st.sampled_from([0.0, 0.001, 0.5, 0.95]))),
        "rs": min(1 - ts, 0.99),
        "rp": (rp := draw(st.sampled_from([0.0, 0.03, 0.5, 0.99]))),
        "tp": min(1 - rp, 0.95),
    }
    return table | {
        "sensor": sensor,
        "panel_rows": rows,
        "panel_cols": cols,
        "slots_per_frame": slots,
        "overlap": draw(st.sampled_from([True, True, False])),
        "serial_number": draw(st.integers(0, 10**6)),
    }


def scene(camera, moving, rng):
    """Radiances over 15 orders side by side; blocks that lie at a border, and take away up to all light."""
    view, n = camera.view, camera.slots_per_frame
    keys = (10 ** rng.uniform(-6, 9, (3, view.rows, view.cols))).astype(np.float32)

    def load(index):
        start, stop = keys[index], keys[index + 1]
        if not moving:
            return Segment(start, stop, (), n)
        late = ((np.arange(n) + 0.5) / n)[:, None, None]
        height, width = -(-view.rows // 2), -(-view.cols // 3)
        row, col = [(0, 0), (view.rows - height, view.cols - width)][index]
        part = np.s_[row : row + height, col : col + width]
        base = (1 - late) * start[part] + late * stop[part]
        # The first leaves at once; the second flickers.
        change = np.where(late > 0.5, -1.0, 0) if index == 0 else np.sin(40 * late)
        return Segment(start, stop, (Block(row, col, (change * base).astype(np.float32)),), n)

    return RadianceVideo.on_view(view, camera.slot_s, load, slots_per_segment=n, n_slots=2 * n)


def shown(camera, levels):
    shape = (camera.slots_per_frame, camera.panel_rows, camera.panel_cols)
    return ExposureCode(np.broadcast_to(np.uint8(levels), shape).copy(), np.zeros(shape[1:], np.bool_))


def even_light(camera, w_m2):
    """Irradiance that is the same everywhere and always."""
    view, n = camera.view, camera.slots_per_frame
    image = np.full((view.rows, view.cols), w_m2, np.float32)
    return IrradianceVideo.on_view(
        view, camera.slot_s, lambda _: Segment(image, image, (), n), slots_per_segment=n, n_slots=2 * n
    )


def steps(segment):
    """Largest step of the moving light, W m^-2 sr^-1."""
    return sum(max(b.excess.max(), 0) - min(b.excess.min(), 0) for b in segment.blocks)


def check_operator(camera, rng):
    """Adjoint; no light from nothing: not negative, nor more than what left the panel."""
    operator = camera.relay_operator()
    fine, ccd = (camera.view.rows, camera.view.cols), operator.ccd_shape
    x, y = rng.standard_normal(fine), rng.standard_normal(ccd)
    there, back = operator.apply(x), operator.adjoint(y)
    scale = np.linalg.norm(there) * np.linalg.norm(y)
    assert abs((there * y).sum() - (x * back).sum()) <= 1e-10 * scale
    energy = 10 ** rng.uniform(-6, 9, fine)
    image = operator.apply(energy)
    assert image.min() >= -ROUNDING * energy.max() / camera.relay.magnification**2
    relay, cell_m2 = camera.relay, (camera.modulator.pitch_m / 3) ** 2
    transmission = relay.transmission * relay.accepted_share(camera.objective.working_f_number)
    sent, arrived = energy.sum() * cell_m2, image.sum() * camera.sensor.pixel_area_m2
    assert arrived <= transmission * sent * (1 + 1e-6)
    # A turned cell's upright box may reach a little over the rim.
    if min(camera.geometry().margin_rows_px, camera.geometry().margin_cols_px) > 1:
        sharp = operator.project(energy).sum() * camera.sensor.pixel_area_m2
        assert sharp == pytest.approx(transmission * sent, rel=1e-6)


def check_frames(camera, moving, rng):
    """Two frames, the panel handed on: finite, not negative, whole numbers within the converter's range."""
    video = scene(camera, moving, rng)
    light, panel = camera.form_image(video), None
    for index in range(2):
        code = shown(camera, rng.choice([0, 1, 128, 255], (camera.slots_per_frame, 1, camera.panel_cols)))
        expected, after = camera.expected_electrons(light, index, code, panel)
        source, segment = video.load(index), light.load(index)
        peak = max(float(np.abs(segment.instant(i)).max()) for i in range(segment.n_instants))
        flat = camera.expected_electrons(even_light(camera, 1.0), index, code, panel)[0] - camera.dark_e
        # What goes on in a straight line in time: far wings and glare.
        share = MOVING_TAIL_SHARE + camera.objective.glare_share + ROUNDING_32
        dip = share * steps(source) * camera.irradiance_per_radiance + ROUNDING * peak
        assert np.isfinite(expected).all()
        assert (expected - camera.dark_e >= -dip * flat.max() - 1e-9).all()
        assert expected.max() > camera.dark_e or flat.max() < 1e-9
        frame, panel = camera.expose(light, index, code, panel, rng)
        np.testing.assert_array_equal(panel.retardance_rad, after.retardance_rad)
        assert frame.dn.dtype == np.uint16
        assert frame.dn.shape == (camera.sensor.rows, camera.sensor.cols)
        assert frame.dn.max() <= camera.sensor.max_dn
        assert moving or frame.negative_light == 0


def check_ends(camera, rng):
    """No light reads as dark, too much of it as the largest number or the full well, nowhere wrapped."""
    sensor = camera.sensor
    noise = 8 * (np.hypot(sensor.read_noise_e, sensor.dsnu_e) + np.sqrt(camera.dark_e)) / sensor.gain_e + 1
    dark, _ = camera.expose(even_light(camera, 0.0), 0, shown(camera, 255), None, rng)
    level = sensor.black_dn + camera.dark_e / sensor.gain_e
    assert (np.abs(dark.dn - min(level, sensor.max_dn)) <= noise).all()
    bright = even_light(camera, 1e12)
    expected = camera.expected_electrons(bright, 0, shown(camera, 255), None)[0]
    inside = expected > 2 * sensor.full_well_e
    full = camera.expose(bright, 0, shown(camera, 255), None, rng)[0].dn
    well = sensor.full_well_e * (1 - sensor.bend_at_full_well) / sensor.gain_e + sensor.black_dn
    assert (full[inside] >= min(well - noise, sensor.max_dn)).all()
    if sensor.smear_share == 0:
        assert (full[inside] <= well + noise).all()
    lit = camera.relay_operator().project(np.ones((camera.view.rows, camera.view.cols)))
    assert inside[lit > 0.5 * max(lit.max(), 1e-9)].all()


def impossible(table):
    """Keys of which an error must name one; none where the parts can work together."""
    keys = []
    sensor = table["sensor"]
    readout = (
        sensor["readout_s"] * sensor["rows"] / sensor["readout_rows"] * table["modulator"]["field_rate_hz"]
    )
    if not table["overlap"] and table["slots_per_frame"] <= np.ceil(readout - 1e-9):
        keys.append("slots_per_frame")
    parts = Splitter(**table["splitter"]), Modulator(**table["modulator"])
    f_number = table["objective"]["f_number"] * table["objective"]["magnification"]
    off, on = (throughput(*parts, retardance, f_number, np.zeros(1))[0] for retardance in (0.0, np.pi))
    if off > on * (1 + 1e-9) or on == 0:
        keys.append("splitter")
    return keys


@pytest.mark.slow
@settings(max_examples=100, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
@given(tables(), st.booleans(), st.integers(0, 2**32))
def test_any_camera_gives_light_and_whole_numbers_or_names_the_key(table, moving, seed):
    keys = impossible(table)
    if keys:
        with pytest.raises(ConfigError, match=rf"({'|'.join(keys)}): "):
            build(CodedCamera, table, where="camera")
        return
    camera = build(CodedCamera, table, where="camera")
    rng = np.random.default_rng(seed)
    assert CodedCamera.model_validate(camera.model_dump()) == camera
    assert camera.contrast >= 1 - 1e-9
    assert camera.panel_gain.min() >= 0
    check_operator(camera, rng)
    check_frames(camera, moving, rng)
    check_ends(camera, rng)


def changed(camera=None, **parts):
    """Make a camera with other values; a table changes the part that is there."""
    table = (camera or demo()).model_dump()
    for name, value in parts.items():
        table[name] = table[name] | value if isinstance(value, dict) else value
    return build(CodedCamera, table, where="test")


def small(rows, cols, ratio=3.0, margin=4, **parts):
    pitch_m = demo().sensor.pitch_m
    sensor = {"rows": int(np.ceil(rows * ratio)) + margin, "cols": int(np.ceil(cols * ratio)) + margin}
    relay = {"magnification": ratio * pitch_m / 20e-6} | parts.pop("relay", {})
    sensor |= parts.pop("sensor", {})
    base = {"panel_rows": rows, "panel_cols": cols, "slots_per_frame": 12, "sensor": sensor, "relay": relay}
    return changed(with_effects(demo(), FLAWS), **(base | parts))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (
            {"overlap": False, "slots_per_frame": 2},
            r"slots_per_frame: got 2, .* the 2 slots .*overlap = true",
        ),
        ({"objective": {"magnification": 0.1}}, r"objective: magnification x f_number: got f/0\.4"),
        (
            {"splitter": {"tp": 0.5, "ts": 0.01, "rs": 0.01, "rp": 0.5, "cleanup_contrast": 1.0}},
            r"splitter: a bright panel passes .* raise tp over ts",
        ),
        (
            {
                "splitter": {
                    "placement": "converging",
                    "acceptance_rad": 1e-3,
                    "ts": 0.0,
                    "tp": 0.01,
                    "rp": 0.99,
                }
            },
            r"splitter: a bright panel passes 0 .*acceptance_rad",
        ),
        ({"modulator": {"delay_s": 0.01}}, r"delay_s \+ scan_s \+ 4 jitter_s: got 0\.01 s"),
        (
            {"modulator": {"delay_s": -4e-3, "jitter_s": 0.5e-3}},
            r"delay_s - 4 jitter_s: got -0\.006 s, expected more than minus a slot of 0\.00555",
        ),
        ({"relay": {"keystone_y": 0.21}}, r"relay\.keystone_y: got 0\.21"),
        ({"relay": {"rotation_rad": -0.06}}, r"relay\.rotation_rad: got -0\.06"),
        ({"objective": {"f_number": float("inf")}}, r"objective\.f_number: got inf"),
        (
            {"splitter": {"tp": 0.98}},
            r"splitter: tp \+ rp: got 0\.98 \+ 0\.03, expected at most 1.*lower one",
        ),
        ({"splitter": {"ts": 0.02}}, r"splitter: ts \+ rs: got 0\.02 \+ 0\.99, expected at most 1"),
    ],
)
def test_parts_that_cannot_work_together_are_refused_with_the_key(parts, message):
    with pytest.raises(ConfigError, match=message):
        changed(**parts)


def test_a_psf_that_no_memory_holds_is_refused_with_the_key_and_the_cure():
    slow = small(2, 2, relay={"tail_share": 1e-4, "f_number": 60.0})
    with pytest.raises(
        ConfigError, match=r"camera\.relay\.tail_share: got 0\.0001.*raise it to 0\.000"
    ) as error:
        slow.relay_operator()
    cure = float(str(error.value).split("raise it to ")[1].split(",")[0])
    with pytest.raises(ConfigError, match="tail_share"):
        changed(slow, relay={"tail_share": cure * 0.9}).relay_operator()
    assert (
        slow.relay.model_copy(update={"tail_share": cure})._check_window(60.0, 4.54e-6, 0.0, 550e-9) is None
    )
    with pytest.raises(ConfigError, match=r"camera\.relay: defocus_m"):
        small(2, 2, relay={"defocus_m": 1.0}).relay_operator()


@pytest.mark.parametrize("diffraction", [True, False])
def test_an_exposure_over_15_orders_of_radiance_is_that_of_dense_float64(diffraction):
    """Written out with sums, in float64: off by float32's steps, and by rounding of the brightest light."""
    lens = {
        "field_error": 1.0,
        "tail_share": 0.05,
        "diffraction": diffraction,
        "glare_share": 0.01 * diffraction,
    }
    camera = small(
        5,
        7,
        modulator={"fringing_px": 0.0},
        objective=lens | {"distortion": 0.0},
        relay=lens | {"ghost_share": 0.0, "distortion": 0.0, "focus": "paraxial"},
    )
    rng, view = np.random.default_rng(5), camera.view
    radiance = np.geomspace(1e-6, 1e9, view.cols) * rng.uniform(0.3, 1, (view.rows, view.cols))
    radiance = radiance.astype(np.float32)
    segment = Segment(radiance, radiance, (), 12)
    video = RadianceVideo.on_view(view, camera.slot_s, lambda _: segment, slots_per_segment=12, n_slots=12)
    code = shown(camera, rng.integers(0, 256, (12, 5, 7)))
    found = camera.expected_electrons(camera.form_image(video), 0, code, None)[0]

    objective, relay, cell_m = camera.objective, camera.relay, camera.modulator.pitch_m / 3
    kernel = objective.psf(6.0, cell_m, radiance.shape).kernel
    image = convolve2d(np.pad(radiance.astype(float), len(kernel) // 2, mode="edge"), kernel, "valid")
    y, x = ((np.arange(n) + 0.5 - n / 2) * cell_m / 1.5 / objective.focal_length_m for n in radiance.shape)
    image *= np.pi * 0.9 / (4 * 6.0**2) / (1 + y[:, None] ** 2 + x**2) ** 2
    image = (1 - objective.glare_share) * image + objective.glare_share * image.mean()
    weights = camera.panel_weights(code, None, 1)[0].astype(float).sum(axis=0) * camera.panel_gain
    energy = image * camera.slot_s * np.kron(weights, np.ones((3, 3)))
    kernel = relay.psf(relay.image_f_number(6.0), cell_m * relay.magnification, radiance.shape).kernel
    half, size = len(kernel) // 2, radiance.shape
    energy = convolve2d(energy, kernel)[half : half + size[0], half : half + size[1]]
    # At three CCD pixels to a panel pixel a fine cell is a CCD pixel, two pixels from the CCD's edge.
    ccd = np.pad(energy, 2) * relay.transmission / relay.magnification**2
    ccd = (1 - relay.glare_share) * ccd + relay.glare_share * ccd.mean()
    expected = ccd * camera.sensor.pitch_m**2 * photons_per_joule() * camera.sensor.quantum_efficiency
    expected += camera.dark_e
    assert expected.max() / expected.min() > (30 if diffraction else 1e12)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-14 * expected.max())


@pytest.mark.parametrize("tau_slots", [(0.0, 0.0), (100.0, 100.0), (100.0, 0.3), (0.02, 100.0)])
def test_response_times_from_0_to_100_slots_are_those_of_a_finely_integrated_equation(tau_slots):
    on_s, off_s = (tau / 180 for tau in tau_slots)
    modulator = {"tau_on_s": on_s, "tau_off_s": off_s, "stuck_share": 0.0}
    camera = small(3, 4, modulator=modulator | {"field_drive": (1.0, 1.0, 1.0), "polarity_drive": 0.0})
    panel, rng, steps_a_slot = camera.panel_at_rest(), np.random.default_rng(7), 2000
    gamma = np.zeros((3, 4))
    share = {tau: np.exp(-1 / 180 / steps_a_slot / tau) if tau else 0.0 for tau in (on_s, off_s)}
    half = {tau: np.exp(-0.5 / 180 / steps_a_slot / tau) if tau else 0.0 for tau in (on_s, off_s)}
    for _ in range(2):
        code = shown(camera, rng.choice([0, 90, 255], (12, 3, 4)))
        weights, panel = camera.panel_weights(code, panel, 1)
        for level, weight in zip(code.levels, weights, strict=True):
            target, mean = np.pi * (level / 255) ** camera.modulator.drive_exponent, np.zeros((3, 4))
            for _ in range(steps_a_slot):
                rising = gamma < target
                mid = target + (gamma - target) * np.where(rising, half[on_s], half[off_s])
                gamma = target + (gamma - target) * np.where(rising, share[on_s], share[off_s])
                mean += np.sin(mid / 2) ** 2 / steps_a_slot
            leak = camera.column_leaks
            # A float32 state is handed on.
            np.testing.assert_allclose(weight, leak + (1 - leak) * mean, atol=2e-6 + WEIGHT_ERROR)
    np.testing.assert_allclose(panel.retardance_rad, gamma, atol=2e-5)


def test_without_contrast_codes_do_nothing_and_with_infinite_contrast_dark_is_dark():
    # A mirror half silvered, without polarisers: each way through it costs half of the light.
    clear = dict.fromkeys(("tp", "ts", "rs", "rp"), 0.5) | {"cleanup_transmission": 1, "cleanup_contrast": 1}
    camera = small(4, 5, splitter=clear)
    assert camera.contrast == pytest.approx(1, rel=1e-12)
    light, rng = even_light(camera, 1e-3), np.random.default_rng(3)
    codes = [shown(camera, levels) for levels in (0, 255, rng.integers(0, 256, (12, 4, 5)))]
    off, on, coded = (camera.expected_electrons(light, 0, code, None)[0] for code in codes)
    np.testing.assert_allclose(off, on, rtol=1e-6)
    np.testing.assert_allclose(coded, on, rtol=1e-6)
    ideal = with_effects(small(4, 5), {"contrast": "ideal", "splitter_shading": "ideal"})
    perfect = changed(ideal, splitter={"ts": 0.0, "rp": 0.0}, modulator={"tau_on_s": 0.0, "tau_off_s": 0.0})
    assert perfect.contrast > 1e12
    off, on, coded = (perfect.expected_electrons(light, 0, code, None)[0] - perfect.dark_e for code in codes)
    assert np.abs(off).max() <= 1e-10 * on.max()
    assert (coded < 0.9 * on)[on > 0.5 * on.max()].all()


def test_columns_that_a_coating_far_from_its_angle_blocks_are_dark():
    splitter = {"ts": 0.0, "tp": 0.5, "rp": 0.5, "acceptance_rad": 3e-3, "collimator_m": 5e-3}
    camera = small(4, 31, splitter=splitter)
    light, code = even_light(camera, 1e-3), shown(camera, 255)
    electrons = camera.expected_electrons(light, 0, code, None)[0] - camera.dark_e
    assert camera.panel_gain[:, [0, -1]].max() == 0
    assert camera.column_leaks[0] == 0
    assert electrons[:, [4, -5]].max() < 0.01 * electrons.max()
    assert electrons[8, 48] > 0.9 * electrons.max()


@pytest.mark.parametrize("ratio", [0.3, 1.0, 2.88, 10.0])
def test_extreme_tilt_keeps_energy_or_says_what_falls_off(ratio):
    tilts = [
        (y, x, d, turn)
        for y in (-0.2, 0.2)
        for x in (0.2, 0.0)
        for d in (-0.2, 0.2)
        for turn in (-0.05, 0.05)
    ]
    for y, x, distortion, turn in tilts:
        tilt = {"keystone_y": y, "keystone_x": x, "distortion": distortion, "rotation_rad": turn}
        camera = small(9, 13, ratio, margin=int(20 * ratio) + 4, relay=tilt)
        assert camera.geometry().fits
        overlap, transmission = camera.relay_operator().overlap, camera.relay.transmission
        transmission *= camera.relay.accepted_share(camera.objective.working_f_number)
        assert overlap.min() >= 0
        # Joules to joules: a cell of the panel has 1 / cell_px^2 of a CCD pixel's area, magnified.
        sums = overlap.sum(axis=0) * camera.sensor.pixel_area_m2 / (camera.modulator.pitch_m / 3) ** 2
        np.testing.assert_allclose(sums, transmission, rtol=1e-6)
        if (y, x, distortion) == (-0.2, 0.2, 0.2):
            tight = small(9, 13, ratio, margin=0, relay=tilt)
            with pytest.raises(GeometryError, match="keystone"):
                tight.geometry().check()
            lost = tight.relay_operator().overlap.sum(axis=0).astype(float)
            assert lost.min() < 0.99 * lost.max()


@pytest.mark.parametrize("shape", [(1, 1), (1, 31), (25, 1), (2, 1), (25, 31)])
def test_panels_of_a_pixel_or_a_line_have_a_pattern_of_mean_one_and_nowhere_below_zero(shape):
    spreads = []
    # On larger panels one in a thousand reaches below zero by itself: 2223 does on 25 x 31.
    for serial in (*range(200), 2223):
        modulator = demo().modulator.model_copy(update={"nonuniformity_rms": 0.2})
        gain = modulator.gain(*shape, serial)
        assert gain.min() >= 0
        assert gain.mean() == pytest.approx(1, abs=0.01)
        spreads.append(gain.std())
    expected = 0.0 if shape == (1, 1) else 0.2
    np.testing.assert_allclose(spreads, expected, atol=0.01)


def test_a_window_that_goes_dark_leaves_neither_light_nor_less_than_none():
    """A mover takes away light 1e4 times as bright as the room, in the corner, where lenses vary most."""
    camera = small(60, 80, objective={"glare_share": 0.0})
    view = camera.view
    room = np.full((view.rows, view.cols), 1e-4, np.float32)
    lit = room.copy()
    lit[20:90, 150:] = 1.0
    gone = np.broadcast_to((room - lit)[20:90, 150:], (4, 70, 90)).copy()

    def instant(base, blocks):
        segment = Segment(base, base, blocks, 4)
        video = RadianceVideo.on_view(view, camera.slot_s, lambda _: segment, slots_per_segment=4, n_slots=4)
        return camera.form_image(video).load(0).instant(3) / camera.irradiance_per_radiance

    left, dark = instant(lit, (Block(20, 150, gone),)), instant(room, ())
    # Far wings lie on splines of panel pixels where they are a mover's, and not where they are the base's.
    assert np.abs(left - dark).max() < 0.04 * MOVING_TAIL_SHARE
    assert left.min() > -0.04 * MOVING_TAIL_SHARE


def test_no_light_is_too_bright_for_the_sensor_and_rounding_is_not_negative_light():
    sensor = changed(sensor={"rows": 3, "cols": 4, "smear_share": 0.0}).sensor
    dn, negative = sensor.digitise(np.full((3, 4), 1e300), 0.2, 1, np.random.default_rng(1))
    full = sensor.full_well_e * (1 - sensor.bend_at_full_well) / sensor.gain_e + sensor.black_dn
    np.testing.assert_allclose(dn, full, atol=6 * sensor.read_noise_e / sensor.gain_e)
    assert negative == 0
    # The rounding of 1e12 electrons, and what is none; without them both are negative light.
    for lamp, count in ((1e12, 4), (0.0, 8)):
        light = np.array([[lamp] * 4, [-1e-3] * 4, [-1.0] * 4])
        assert sensor.digitise(light, 0.2, 1, np.random.default_rng(1))[1] == count
