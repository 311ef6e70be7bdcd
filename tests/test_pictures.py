"""Pictures on surfaces declare their meaning: it is honoured, or refused with its name."""

import io
import struct
import zlib

import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageCms

from optsim.core.errors import OptsimError
from optsim.scene.pictures import read_map, read_picture

# Of the coded value 51/255 by sRGB's formula.
LIGHT = ((51 / 255 + 0.055) / 1.055) ** 2.4


def exr(path, header=None, **channels):
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **(header or {})}
    planes = {name.replace("_", "."): np.full((2, 3), value, np.float32) for name, value in channels.items()}
    with OpenEXR.File(head, planes) as file:
        file.write(str(path))
    return path


def png(path, pixels, colour=2, bits=8, chunks=()):
    """Write a PNG byte by byte: Pillow writes no 16-bit colour."""
    rows = b"".join(b"\0" + row.astype(f">u{bits // 8}").tobytes() for row in pixels)
    head = struct.pack(">IIBBBBB", pixels.shape[1], len(pixels), bits, colour, 0, 0, 0)
    parts = [(b"IHDR", head), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    content = b"".join(
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in parts
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    return path


@pytest.mark.parametrize(
    ("channels", "value"),
    [
        ({"Y": 0.25, "A": 1.0}, 0.25),
        ({"R": 0.2, "G": 0.2, "B": 0.2, "A": 1.0, "Z": 7.0}, 0.2),
        ({"grey": 0.3}, 0.3),
    ],
)
def test_an_exr_is_taken_by_meaning(tmp_path, channels, value):
    np.testing.assert_allclose(read_picture(exr(tmp_path / "a.exr", **channels)), value, rtol=1e-6)


@pytest.mark.parametrize(
    ("channels", "header", "message"),
    [
        ({"A": 1.0}, {}, "got the channels A, expected R, G and B"),
        ({"R": 0.5, "G": 0.5}, {}, "got the channels G, R, expected"),
        ({"view_R": 0.5, "view_G": 0.5, "view_B": 0.5}, {}, r"got the channels view\.B, view\.G, view\.R"),
        ({"Y": 0.25, "A": 0.5}, {}, "got alpha down to 0.5, expected an opaque picture"),
        ({"X": 0.1, "Y": 0.2, "Z": 0.3}, {}, "got the channels X, Y, Z, expected"),
        ({"Y": 0.25, "RY": 0.1, "BY": 0.1}, {}, "got the channels BY, RY, Y, expected"),
        ({"Depth_V": 3.0}, {}, r"got the channels Depth\.V, expected"),
        ({"alpha": 1.0}, {}, "got the channels alpha, expected"),
        ({"Y": -0.5, "x": 1.0}, {}, "got -0.5 in row 0, column 0, expected finite values"),
        (
            {"R": 0.2, "G": 0.2, "B": 0.2},
            {"chromaticities": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.3217, 0.3377)},
            r"got primaries with red at \(0\.713, 0\.293\), expected BT\.709",
        ),
    ],
)
def test_an_exr_of_another_meaning_is_refused_by_name(tmp_path, channels, header, message):
    with pytest.raises(OptsimError, match=message) as caught:
        read_picture(exr(tmp_path / "a.exr", header, **channels))
    assert "\n" not in str(caught.value)


def test_light_barely_below_zero_is_zero_with_a_remark(tmp_path):
    light = np.full((4, 8), 2.0, np.float32)
    light[1, 2] = -0.012
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, worst in (("a.exr", -0.012), ("b.exr", -0.03)):
        light[1, 2] = worst
        with OpenEXR.File(head, {"Y": light}) as file:
            file.write(str(tmp_path / name))
    with pytest.warns(UserWarning, match=r"below zero, by 0\.006 of the largest at most, are taken as 0"):
        seen = read_picture(tmp_path / "a.exr")
    assert seen.min() == 0
    with pytest.raises(OptsimError, match=r"got -0\.02.* in row 1, column 2"):
        read_picture(tmp_path / "b.exr")


def test_the_content_decides_not_the_suffix(tmp_path):
    for kind, name in (("JPEG", "a.png"), ("PNG", "a.jpg"), ("PNG", "a.exr")):
        Image.new("RGB", (8, 8), (51, 51, 51)).save(tmp_path / name, format=kind)
        np.testing.assert_allclose(
            read_picture(tmp_path / name), LIGHT, rtol=2e-2 if kind == "JPEG" else 1e-6
        )
    exr(tmp_path / "b.exr", Y=0.4).rename(tmp_path / "b.png")
    np.testing.assert_allclose(read_picture(tmp_path / "b.png"), 0.4, rtol=1e-6)


@pytest.mark.parametrize(
    ("mode", "fill"),
    [("RGBA", (51, 51, 51, 255)), ("LA", (51, 255)), ("L", 51), ("P", 0)],
)
def test_an_opaque_picture_of_any_kind_is_itself(tmp_path, mode, fill):
    image = Image.new(mode, (2, 2), fill)
    if mode == "P":
        image.putpalette([51, 51, 51] + [255] * 765)
    image.save(tmp_path / "a.png")
    np.testing.assert_allclose(read_picture(tmp_path / "a.png"), LIGHT, rtol=1e-6)


def test_sixteen_bits_of_colour_are_all_read(tmp_path):
    rng = np.random.default_rng(1)
    for colour, n in ((2, 3), (6, 4)):
        codes = rng.integers(0, 65536, (5, 4, n))
        codes[..., 3:] = 65535
        path = png(tmp_path / f"{n}.png", codes, colour, 16)
        found = read_map(path, "roughness_map")
        np.testing.assert_allclose(found, codes[::-1, :, 1] / 65535, atol=1e-7)


@pytest.mark.parametrize(
    ("chunk", "value"),
    [
        ((b"gAMA", struct.pack(">I", 100000)), 51 / 255),
        ((b"gAMA", struct.pack(">I", 50000)), (51 / 255) ** 2),
        ((b"sRGB", b"\0"), LIGHT),
    ],
)
def test_the_curve_that_a_png_states_is_honoured(tmp_path, chunk, value):
    path = png(tmp_path / "a.png", np.full((2, 2, 3), 51), chunks=[chunk])
    np.testing.assert_allclose(read_picture(path), value, rtol=1e-6)
    np.testing.assert_allclose(read_map(path, "roughness_map"), 0.2, rtol=1e-6)


def test_a_colour_profile_is_honoured(tmp_path):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    # The same primaries, with red and blue exchanged: what it calls red is blue.
    swapped = srgb.replace(b"rXYZ", b"tmpX", 1).replace(b"bXYZ", b"rXYZ", 1).replace(b"tmpX", b"bXYZ", 1)
    # Only the profile's name makes a reader take it for sRGB.
    swapped = swapped.replace("sRGB".encode("utf-16-be"), "abcd".encode("utf-16-be"))
    assert ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(swapped))).startswith("abcd")
    image = Image.new("RGB", (4, 4), (200, 51, 10))
    for name, profile, channel in (("a", srgb, "R"), ("b", swapped, "B")):
        for kind in ("png", "jpg"):
            image.save(tmp_path / f"{name}.{kind}", icc_profile=profile)
            seen = read_picture(tmp_path / f"{name}.{kind}", channel)
            assert seen.mean() == pytest.approx(((200 / 255 + 0.055) / 1.055) ** 2.4, rel=0.03)


def linear_profile(kind="RGB "):
    """Profile of linear light that calls itself sRGB, as GIMP's does."""
    number = struct.Struct(">i").pack

    def place(*xyz):
        return b"XYZ \0\0\0\0" + b"".join(number(round(65536 * value)) for value in xyz)

    name, curve = b"GIMP built-in Linear sRGB\0", b"curv" + bytes(8)
    named = b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78)
    tags = {b"desc": named + bytes(-len(named) % 4), b"wtpt": place(0.9642, 1, 0.8249)}
    if kind == "GRAY":
        tags[b"kTRC"] = curve
    else:
        tags |= {b"rXYZ": place(0.436, 0.2225, 0.0139), b"gXYZ": place(0.3851, 0.7169, 0.0971)}
        tags |= {b"bXYZ": place(0.1431, 0.0606, 0.7141), b"rTRC": curve, b"gTRC": curve, b"bTRC": curve}
    table, body = struct.pack(">I", len(tags)), b""
    for key, content in tags.items():
        table += key + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(content))
        body += content
    head = b"lcms" + struct.pack(">I", 0x02100000) + b"mntr" + kind.encode() + b"XYZ " + bytes(12) + b"acsp"
    head += bytes(28) + number(63190) + number(65536) + number(54061) + bytes(48)
    return struct.pack(">I", 132 + 12 * len(tags) + len(body)) + head + table + body


@pytest.mark.parametrize(("mode", "kind"), [("RGB", "RGB "), ("L", "RGB "), ("L", "GRAY"), ("LA", "GRAY")])
def test_a_profile_counts_by_what_it_does_not_by_its_name(tmp_path, mode, kind):
    fill = {"L": 51, "LA": (51, 255), "RGB": (51, 51, 51)}[mode]
    Image.new(mode, (2, 2), fill).save(tmp_path / "a.png", icc_profile=linear_profile(kind))
    np.testing.assert_allclose(read_picture(tmp_path / "a.png"), 0.2, atol=2e-3)


def jpeg(path, mode="RGB", **options):
    Image.new(mode, (8, 8)).save(path, format="JPEG", **options)


def turned(path):
    exif = Image.Exif()
    exif[274] = 6
    jpeg(path, exif=exif)


def moving(path):
    frames = [Image.new("RGB", (4, 4), (k, k, k)) for k in (10, 200)]
    frames[0].save(path, format="PNG", save_all=True, append_images=frames[1:])


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: Image.new("RGBA", (4, 4), (9, 9, 9, 128)).save(path, "PNG"), r"alpha down to 0\.502"),
        (lambda path: Image.new("LA", (4, 4), (9, 0)).save(path, "PNG"), "alpha down to 0, expected"),
        (lambda path: Image.new("RGB", (4, 4)).save(path, "PNG", transparency=(0, 0, 0)), "alpha down to 0"),
        (lambda path: jpeg(path, "CMYK"), "colours of kind CMYK"),
        (turned, "EXIF orientation 6"),
        (
            lambda path: Image.new("RGB", (4, 4)).save(path, "PNG", icc_profile=linear_profile("GRAY")),
            "colours with a profile of greys",
        ),
        (lambda path: png(path, np.full((2, 2, 2), 65535), 4, 16), "16 bits with transparency"),
        (moving, "an animation"),
        (lambda path: Image.new("RGB", (4, 4)).save(path, "GIF"), "cannot be read as a PNG, JPEG"),
        (
            lambda path: png(path, np.ones((2, 2, 3)), chunks=[(b"cICP", bytes([9, 16, 0, 1]))]),
            "the curve PQ, BT",
        ),
    ],
)
def test_what_is_not_honoured_is_refused_by_name(tmp_path, write, message):
    write(tmp_path / "a.png")
    with pytest.raises(OptsimError, match=message) as caught:
        read_picture(tmp_path / "a.png")
    assert str(tmp_path / "a.png") in str(caught.value)
    assert "\n" not in str(caught.value)
