"""Radiance's pictures: Mitsuba's writer and reader as oracle, what a header declares, damage in a line."""

import subprocess
import sys

import numpy as np
import pytest

from optsim.core.errors import ConfigError, OptsimError, StorageError
from optsim.core.foreign.rgbe import rgbe_pixels
from optsim.scene import load_scene
from optsim.scene.pictures import read_picture

SCENE = """
name = "x"
white_w_m2_sr = 1.0
[camera]
position_m = [0, 0, 3]
target_m = [0, 0.1, 0]
[materials.grey]
[objects.floor]
kind = "quad"
material = "grey"
corner_m = [-9, -9, 0]
edge_u_m = [18, 0, 0]
edge_v_m = [0, 18, 0]
[sky]
kind = "picture"
file = "sky.hdr"
radiance_w_m2_sr = 2.0
"""

ORACLE = """
import mitsuba as mi, numpy as np
mi.set_variant("scalar_rgb")
mi.Bitmap(np.load("in.npy")).write("a.hdr")
np.save("out.npy", np.array(mi.Bitmap("a.hdr")))
"""


def flat(size=b"-Y 1 +X 2", head=b"FORMAT=32-bit_rle_rgbe\n", pixels=bytes([128, 64, 0, 129] * 2)):
    """Two pixels without run lengths: twice (128.5, 64.5, 0.5) / 128."""
    return b"#?RADIANCE\n# made by hand\n" + head + b"\n" + size + b"\n" + pixels


def test_it_reads_what_mitsuba_writes_and_as_mitsuba_reads_it(tmp_path):
    rng = np.random.default_rng(5)
    light = rng.lognormal(0, 3, (40, 80, 3)).astype(np.float32)
    light[10:20, 5:70] = 0.25  # long runs
    light[3] = 0
    np.save(tmp_path / "in.npy", light)
    subprocess.run([sys.executable, "-c", ORACLE], cwd=tmp_path, check=True)
    ours, theirs = rgbe_pixels(tmp_path / "a.hdr"), np.load(tmp_path / "out.npy")
    assert (tmp_path / "a.hdr").stat().st_size < light.size * 4 / 3, "nothing is run-length encoded"
    # One step is 1/128 of the power of two above the largest channel; Mitsuba takes a step's lower end.
    step = 2.0 ** (np.floor(np.log2(np.maximum(theirs.max(axis=2), 1e-30))) - 7)[..., None]
    lit = theirs.max(axis=2, keepdims=True) > 0
    np.testing.assert_allclose(ours - theirs, np.where(lit, step / 2, np.zeros(3)))
    assert (abs(ours - light) <= 0.5001 * step).all()


def test_what_a_header_declares_counts(tmp_path):
    (tmp_path / "a.hdr").write_bytes(flat())
    np.testing.assert_allclose(rgbe_pixels(tmp_path / "a.hdr")[0, 1] * 128, [128.5, 64.5, 0.5])
    (tmp_path / "a.hdr").write_bytes(flat(head=b"EXPOSURE=4\nEXPOSURE= 0.5\nPIXASPECT=1.0\n"))
    np.testing.assert_allclose(rgbe_pixels(tmp_path / "a.hdr")[0, 1] * 128, [64.25, 32.25, 0.25])
    (tmp_path / "a.hdr").write_bytes(flat(head=b"COLORCORR=2 1 0.5\nEXPOSURE=2\nCOLORCORR= 1 4 1\n"))
    np.testing.assert_allclose(rgbe_pixels(tmp_path / "a.hdr")[0, 1] * 128, [128.5 / 4, 64.5 / 8, 0.5])
    # Indented lines are of the pictures that this one was made from.
    (tmp_path / "a.hdr").write_bytes(flat(head=b"pcomb a.hdr\n\tEXPOSURE=9\n\tFORMAT=32-bit_rle_xyze\n"))
    np.testing.assert_allclose(rgbe_pixels(tmp_path / "a.hdr")[0, 1] * 128, [128.5, 64.5, 0.5])
    # Linear light, row 0 below.
    image = flat(b"-Y 2 +X 1", pixels=bytes([128, 128, 128, 129, 0, 0, 0, 0]))
    (tmp_path / "a.hdr").write_bytes(image)
    np.testing.assert_allclose(read_picture(tmp_path / "a.hdr"), [[0], [128.5 / 128]], rtol=1e-5)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"#?RADISH\n", "it doesn't begin as one"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n", "its header is incomplete"),
        (flat(head=b"FORMAT=32-bit_rle_xyze\n"), "its format is 32-bit_rle_xyze"),
        (flat(head=b"PIXASPECT=2\n"), "its pixels are oblong"),
        (flat(head=b"PRIMARIES=0.7 0.3 0.2 0.7 0.1 0.0 0.3 0.3\n"), "its primaries are 0.7"),
        (flat(head=b"EXPOSURE=0\n"), "it declares exposure 0"),
        (flat(head=b"COLORCORR=1 0 1\n"), "it declares exposure 0"),
        (flat(head=b"GAMMA=2.2\n"), "its values have a gamma of 2.2"),
        (flat(size=b"+Y 1 +X 2"), r"its orientation is \+Y 1 \+X 2"),
        (flat(size=b"-Y 90000 +X 90000"), "it declares 90000 x 90000 pixels, but holds 8 bytes"),
        (flat(pixels=bytes(7)), "but holds 7 bytes"),
        (flat(size=b"-Y 1 +X 16", pixels=bytes([2, 2, 0, 16] + [144, 7] * 3 + [20] * 9)), "cut"),
        (flat(size=b"-Y 1 +X 16", pixels=bytes([2, 2, 0, 16, 0] + [0] * 20)), "a run of no pixels"),
    ],
)
def test_damage_is_one_line(tmp_path, content, message):
    (tmp_path / "sky.hdr").write_bytes(content)
    (tmp_path / "scene.toml").write_text(SCENE)
    with pytest.raises(StorageError, match=message) as caught:
        load_scene(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'sky.hdr'} cannot be read as a Radiance picture")
    assert "\n" not in str(caught.value)


def test_a_sky_from_it_is_that_of_an_exr(tmp_path):
    from optsim.core.files import write_exr

    (tmp_path / "scene.toml").write_text(SCENE)
    rows = b"".join(bytes([100 + row, 50, 25, 130]) * 16 for row in range(8))
    (tmp_path / "sky.hdr").write_bytes(flat(b"-Y 8 +X 16", pixels=rows))
    seen = load_scene(tmp_path).sky.radiance()
    light = rgbe_pixels(tmp_path / "sky.hdr")
    write_exr(tmp_path / "sky.exr", {n: light[..., k] for k, n in enumerate("RGB")}, attributes={})
    (tmp_path / "scene.toml").write_text(SCENE.replace("sky.hdr", "sky.exr"))
    np.testing.assert_array_equal(load_scene(tmp_path).sky.radiance(), seen)
    assert seen[7, 0] > seen[0, 0]


@pytest.mark.parametrize(
    ("pixels", "size", "message"),
    [
        (bytes(4 * 8), b"-Y 2 +X 4", "expected twice as wide as high"),
        (bytes(4 * 128), b"-Y 8 +X 16", "got a black picture"),
    ],
)
def test_a_sky_is_checked_as_an_exr_is(tmp_path, pixels, size, message):
    (tmp_path / "sky.hdr").write_bytes(flat(size, pixels=pixels))
    (tmp_path / "scene.toml").write_text(SCENE)
    with pytest.raises(ConfigError, match=message):
        load_scene(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE.replace("sky.hdr", "sky.png"))
    (tmp_path / "sky.png").write_bytes(b"")
    with pytest.raises(OptsimError, match=r"expected OpenEXR or Radiance"):
        load_scene(tmp_path)
