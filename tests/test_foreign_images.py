"""Images that others wrote: what a file says of its pixels is honoured or refused, damage is an error."""

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import tifffile
from PIL import Image
from recorded import codes16, signal, slots, truth

from optsim.core.errors import ConfigError, OptsimError, StorageError, ValueCheckError
from optsim.core.files import read_exr, read_png16, read_words, write_exr
from optsim.experiment.measurement.files import MeasurementFiles, read_measurement
from optsim.footage.clips import open_clips
from optsim.footage.recording import FileStatement, open_recording

PICTURE = np.random.default_rng(2).integers(0, 65535, (5, 8)).astype(np.uint16)
LIGHT = PICTURE.astype(np.float32)


def first(path: Path, key: str | None = None) -> np.ndarray:
    """Pixels of the first frame, grey without its channel axis."""
    pixels = next(open_recording(path, key=key).read(0))
    return pixels[..., 0] if pixels.shape[2] == 1 else pixels


# --- OpenEXR ------------------------------------------------------------------------------------------------


def exr(path: Path, channels: dict[str, np.ndarray], **header: object) -> Path:
    plain = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File({**plain, **header}, channels) as stream:
        stream.write(str(path))
    return path


def exr_of_parts(path: Path, **parts: dict[str, np.ndarray]) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File([OpenEXR.Part({**header, "name": n}, c) for n, c in parts.items()]) as stream:
        stream.write(str(path))
    return path


def chunk_offsets(content: bytes, parts: int) -> int:
    """Where the table of the first part's chunks begins, behind the headers."""
    at = 8
    for _ in range(parts):
        while content[at]:
            kind = content.index(0, content.index(0, at) + 1)
            at = kind + 5 + struct.unpack("<i", content[kind + 1 : kind + 5])[0]
        at += 1
    return at + (parts > 1)


@pytest.mark.parametrize("order", [("depth", "beauty"), ("beauty", "depth")])
def test_a_part_is_chosen_by_name_and_never_by_place(order: tuple[str, ...], tmp_path: Path) -> None:
    held = {"beauty": {"Y": LIGHT}, "depth": {"Z": LIGHT + 500}}
    path = exr_of_parts(tmp_path / "a.exr", **{name: held[name] for name in order})
    with pytest.raises(ConfigError, match=r"parts .*depth \(Z\)"):
        first(path)
    for key in ("beauty", "beauty.Y", "Y"):
        assert np.array_equal(first(path, key), LIGHT)
    assert np.array_equal(first(path, "depth.Z"), LIGHT + 500)
    with pytest.raises(ConfigError, match=r"got 'beaty'; a\.exr holds the parts"):
        first(path, "beaty")
    with pytest.raises(StorageError, match=r"holds the parts .*, expected one"):
        read_exr(path)


@pytest.mark.parametrize("damaged", [0, 1])
def test_a_damaged_part_is_an_error_whichever_is_asked_for(damaged: int, tmp_path: Path) -> None:
    path = exr_of_parts(tmp_path / "a.exr", one={"Y": LIGHT}, two={"Y": LIGHT + 1})
    content = bytearray(path.read_bytes())
    # One chunk a part: 5 rows fit into one of 16.
    chunk = struct.unpack_from("<Q", content, chunk_offsets(content, 2) + 8 * damaged)[0]
    content[chunk + 4 : chunk + 8] = b"\xff\xff\xff\x7f"
    path.write_bytes(content)
    for key in ("one", "two"):
        with pytest.raises(StorageError, match="1 of 2 parts are damaged"):
            first(path, key)


@pytest.mark.parametrize("lost", [3, 60, 200, 10**6])
def test_a_cut_exr_is_an_error(lost: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = exr(tmp_path / "a.exr", {"Y": LIGHT}).read_bytes()
    (tmp_path / "a.exr").write_bytes(whole[: max(0, len(whole) - lost)])
    with pytest.raises(StorageError, match=r"a\.exr cannot be read as OpenEXR"):
        first(tmp_path / "a.exr")
    # What the library prints must not stand in the midst of JSON.
    assert capfd.readouterr().out == ""


def test_a_changed_byte_in_a_chunk_is_an_error(tmp_path: Path) -> None:
    # Even rows: a chunk that compression makes no smaller is stored as it is, without a checksum.
    path = exr(tmp_path / "a.exr", {"Y": np.tile(LIGHT[:1], (5, 1))})
    content = bytearray(path.read_bytes())
    content[-20] ^= 255
    path.write_bytes(content)
    with pytest.raises(StorageError, match="damaged"):
        first(path)


def test_a_declared_window_is_not_believed(tmp_path: Path) -> None:
    path = exr(tmp_path / "a.exr", {"Y": LIGHT})
    content = bytearray(path.read_bytes())
    at = content.index(b"dataWindow\0box2i\0") + 21
    content[at : at + 16] = struct.pack("<4i", 0, 0, 10**6, 10**6)
    path.write_bytes(content)
    with pytest.raises(StorageError, match=r"declares 3\.73e\+03 GiB"):
        first(path)


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ({"dataWindow": ((2, 0), (9, 4)), "displayWindow": ((0, 0), (11, 4))}, r"dataWindow is \(2, 0\) to"),
        ({"dataWindow": ((-1, 0), (6, 4)), "displayWindow": ((0, 0), (5, 4))}, "dataWindow is"),
        ({"pixelAspectRatio": 2.0}, "pixelAspectRatio is 2"),
    ],
)
def test_exr_pixels_of_another_place_or_shape_are_refused(
    header: dict[str, object], text: str, tmp_path: Path
) -> None:
    path = exr(tmp_path / "a.exr", {"Y": LIGHT}, **header)
    for read in (first, read_exr):
        with pytest.raises(ValueCheckError, match=text):
            read(path)


def test_deep_and_subsampled_exr_are_refused(tmp_path: Path) -> None:
    deep = np.empty(LIGHT.shape, object)
    for at in np.ndindex(LIGHT.shape):
        deep[at] = np.ones(2, np.float32)
    exr(tmp_path / "deep.exr", {"Y": deep}, type=OpenEXR.deepscanline, compression=OpenEXR.ZIPS_COMPRESSION)
    with pytest.raises(ValueCheckError, match="is deep"):
        first(tmp_path / "deep.exr")
    even = LIGHT[:4]
    exr(tmp_path / "half.exr", {"Y": OpenEXR.Channel(even, 2, 2)})
    with pytest.raises(ValueCheckError, match="channel Y is subsampled to 2 x 4 values"):
        first(tmp_path / "half.exr")


def test_rows_from_below_and_windows_off_the_origin_mean_the_same_picture(tmp_path: Path) -> None:
    away = {"dataWindow": ((7, 3), (14, 7)), "displayWindow": ((7, 3), (14, 7))}
    for header in ({"lineOrder": OpenEXR.DECREASING_Y}, away):
        assert np.array_equal(first(exr(tmp_path / "a.exr", {"Y": LIGHT}, **header)), LIGHT)


@pytest.mark.parametrize("said", ["made by hand", "[1, 2]", "[" * 5000, 3.5])
def test_a_foreign_attribute_of_our_name_is_no_attribute_of_ours(said: object, tmp_path: Path) -> None:
    channels, attributes = read_exr(exr(tmp_path / "a.exr", {"Y": LIGHT}, optsim=said))
    assert attributes == {}
    assert np.array_equal(channels["Y"], LIGHT)
    write_exr(tmp_path / "b.exr", {"Y": LIGHT}, attributes={"unit": "W"})
    assert read_exr(tmp_path / "b.exr")[1] == {"unit": "W"}


@pytest.mark.parametrize("name", ["Z", "A"])
def test_depth_and_opacity_are_no_light_unless_asked_for(name: str, tmp_path: Path) -> None:
    path = exr(tmp_path / "a.exr", {name: LIGHT})
    with pytest.raises(ConfigError, match=f"key: missing; a.exr holds the channels {name}"):
        first(path)
    assert np.array_equal(first(path, name), LIGHT)


def test_slots_of_a_code_are_not_mixed_with_other_channels(tmp_path: Path) -> None:
    write_exr(tmp_path / "image.exr", {"Y": LIGHT}, attributes={})
    code = {f"slot{k}": np.ones_like(LIGHT) for k in range(3)}
    write_exr(tmp_path / "code.exr", {**code, "A": np.ones_like(LIGHT)}, attributes={})
    with pytest.raises(ValueCheckError, match=r"code: .*got channels A, slot0, slot1, slot2"):
        read_measurement(MeasurementFiles(image=str(tmp_path / "image.exr"), code=str(tmp_path / "code.exr")))


# --- TIFF ---------------------------------------------------------------------------------------------------


def tif(path: Path, pixels: np.ndarray = PICTURE, **tags: object) -> Path:
    tifffile.imwrite(path, pixels, metadata=None, **tags)
    return path


def tag(number: int, value: int) -> list[tuple[int, str, int, int, bool]]:
    return [(number, "H", 1, value, True)]


# By the words of TIFF 6.0: (row 0, column 0) of the stored array is the picture's (edge, edge).
CORNERS = {
    1: PICTURE,
    2: np.fliplr(PICTURE),
    3: np.flipud(np.fliplr(PICTURE)),
    4: np.flipud(PICTURE),
    5: PICTURE.T,
    6: np.fliplr(PICTURE.T),
    7: np.fliplr(np.flipud(PICTURE.T)),
    8: np.flipud(PICTURE.T),
}


@pytest.mark.parametrize("orientation", CORNERS)
def test_tiff_orientation_is_honoured(orientation: int, tmp_path: Path) -> None:
    path = tif(tmp_path / "a.tif", extratags=tag(274, orientation))
    assert np.array_equal(first(path), CORNERS[orientation])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
def test_where_white_is_zero_values_are_turned_round(dtype: type, tmp_path: Path) -> None:
    stored = PICTURE.astype(dtype)
    path = tif(tmp_path / "a.tif", stored, photometric="miniswhite")
    assert np.array_equal(first(path).astype(np.int64), int(np.iinfo(dtype).max) - stored.astype(np.int64))
    assert first(path).dtype == dtype


def test_colours_in_planes_are_colours(tmp_path: Path) -> None:
    colours = np.stack([PICTURE, PICTURE + 1, PICTURE + 2])
    path = tif(tmp_path / "a.tif", colours, photometric="rgb", planarconfig="separate")
    assert np.array_equal(first(path), np.moveaxis(colours, 0, -1))


FOUR = np.stack([PICTURE] * 4, axis=-1)


@pytest.mark.parametrize(
    ("pixels", "tags", "text"),
    [
        (PICTURE.astype(np.int16), {"photometric": "miniswhite"}, "min-is-white of int16"),
        (PICTURE, {"photometric": "palette", "colormap": np.zeros((3, 65536), np.uint16)}, "PALETTE"),
        (PICTURE, {"photometric": "mask"}, "MASK"),
        (PICTURE, {"photometric": "cfa"}, "CFA"),
        (FOUR, {"photometric": "separated"}, "SEPARATED"),
        (FOUR[..., :3].astype(np.uint8), {"photometric": "ycbcr"}, "YCBCR"),
        (FOUR[..., :3], {"photometric": "cielab"}, "CIELAB"),
        (FOUR, {"photometric": "rgb", "extrasamples": ["unassalpha"]}, "ExtraSamples says alpha"),
        (FOUR, {"photometric": "rgb", "extrasamples": ["assocalpha"]}, "ExtraSamples says alpha"),
        (PICTURE.astype(np.complex64), {}, "SampleFormat"),
        (PICTURE, {"subfiletype": 1}, "NewSubfileType says REDUCEDIMAGE"),
        (PICTURE, {"resolution": (72, 36)}, "expected square pixels"),
        (PICTURE, {"extratags": tag(274, 9)}, "Orientation says 9"),
    ],
)
def test_tiff_numbers_that_mean_something_else_are_refused(
    pixels: np.ndarray, tags: dict[str, object], text: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueCheckError, match=text):
        first(tif(tmp_path / "a.tif", pixels, **tags))


@pytest.mark.parametrize("pages", ["sizes", "thumbnail", "channels"])
def test_pages_that_are_no_frames_are_refused(pages: str, tmp_path: Path) -> None:
    path = tmp_path / "a.ome.tif"
    if pages == "channels":
        axes = {"axes": "TCYX"}
        tifffile.imwrite(path, np.stack([[PICTURE, PICTURE]] * 3), metadata=axes, photometric="minisblack")
    else:
        with tifffile.TiffWriter(path) as writer:
            writer.write(PICTURE, metadata=None)
            writer.write(PICTURE[::2, ::2], metadata=None, subfiletype=int(pages == "thumbnail"))
    with pytest.raises(OptsimError, match=r"all frames must be alike|REDUCEDIMAGE|along T \(3\), C \(2\)"):
        list(open_recording(path).read(0))


def damaged_tiff(path: Path, how: str) -> Path:
    stack = how in ("next page", "cut pages")
    with tifffile.TiffWriter(path) as writer:
        for _ in range(4 if stack else 1):
            writer.write(
                np.tile(PICTURE, (4, 1)),
                metadata=None,
                rowsperstrip=4,
                compression=None if how in ("width", "counts", "offsets") else "zlib",
            )
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as opened:
        page = opened.pages[1 if stack else 0]
        tags = {number: page.tags[number] for number in (256, 273, 279)}
        size = {3: 2, 4: 4}
        places = {n: (t.valueoffset, size[int(t.dtype)]) for n, t in tags.items()}
        strip, length, ifd = page.dataoffsets[1], page.databytecounts[1], page.offset
    if how in ("counts", "offsets"):
        at, width = places[279 if how == "counts" else 273]
        content[at + 2 * width : at + 4 * width] = bytes(2 * width)
    elif how == "width":
        at, width = places[256]
        content[at : at + width] = (60000).to_bytes(width, "little")
    elif how == "byte":
        content[strip + length // 2] ^= 255
    elif how == "next page":
        entries = int.from_bytes(content[ifd : ifd + 2], "little")
        content[ifd + 2 + 12 * entries : ifd + 6 + 12 * entries] = (len(content) + 9).to_bytes(4, "little")
    else:
        content = content[: len(content) * 2 // 3]
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("how", ["counts", "offsets", "width", "byte", "next page", "cut", "cut pages"])
def test_tiff_damage_is_an_error(how: str, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"a\.tif"):
        list(open_recording(damaged_tiff(tmp_path / "a.tif", how)).read(0))


# --- PNG ----------------------------------------------------------------------------------------------------


def chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png(
    path: Path, *extra: bytes, bits: int = 16, colour: int = 0, pixels: bytes | None = None, **size: int
) -> Path:
    """A PNG of PICTURE, with chunks before its pixels, or of other pixels."""
    rows, cols = size.get("rows", len(PICTURE)), size.get("cols", PICTURE.shape[1])
    raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in PICTURE) if pixels is None else pixels
    head = struct.pack(">IIBBBBB", cols, rows, bits, colour, 0, 0, 0)
    chunks = [chunk(b"IHDR", head), *extra, chunk(b"IDAT", zlib.compress(raw)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    return path


def test_a_plain_png_is_read_as_stored(tmp_path: Path) -> None:
    path = png(tmp_path / "a.png", chunk(b"pHYs", struct.pack(">IIB", 0, 1, 0)), chunk(b"tEXt", b"a\0b"))
    assert np.array_equal(first(path), PICTURE)
    assert np.array_equal(read_png16(path), PICTURE)


ROWS = b"\0\x1b\x1b" * 5  # rows of 2 bytes
EXIF = chunk(b"eXIf", b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0")


@pytest.mark.parametrize(
    ("extra", "keys", "text"),
    [
        ([], {"bits": 1, "pixels": ROWS, "cols": 16}, "PNG of 1 bits, grey"),
        ([], {"bits": 2, "pixels": ROWS}, "PNG of 2 bits, grey"),
        ([], {"bits": 4, "pixels": ROWS, "cols": 4}, "PNG of 4 bits, grey"),
        ([], {"colour": 4, "cols": 4}, "grey with alpha"),
        ([], {"colour": 6, "cols": 2}, "RGB with alpha"),
        ([chunk(b"PLTE", b"abc" * 16)], {"bits": 8, "colour": 3, "cols": 16}, "palette"),
        ([chunk(b"tRNS", b"\0\7")], {}, "grey, transparency"),
        ([chunk(b"acTL", b"\0\0\0\2\0\0\0\0")], {}, "animated"),
        ([chunk(b"pHYs", struct.pack(">IIB", 2, 1, 0))], {}, "2 x 1 pixels a unit"),
        ([EXIF], {}, "orientation 6"),
    ],
)
def test_png_numbers_that_mean_something_else_are_refused(
    extra: list[bytes], keys: dict[str, object], text: str, tmp_path: Path
) -> None:
    path = png(tmp_path / "a.png", *extra, **keys)
    for read in (first, read_png16):
        with pytest.raises(ValueCheckError, match=text):
            read(path)


@pytest.mark.parametrize(
    "how", ["no pixels", "few pixels", "huge", "byte", "checksum", "cut", "text", "empty"]
)
def test_png_damage_is_an_error(how: str, tmp_path: Path) -> None:
    path = png(tmp_path / "a.png", pixels=b"\0" * 40 if how == "few pixels" else None)
    content = bytearray(path.read_bytes())
    at = content.index(b"IDAT")
    if how == "no pixels":
        size = int.from_bytes(content[at - 4 : at], "big")
        del content[at - 4 : at + 8 + size]
    elif how == "huge":
        png(path, cols=10**6, rows=10**6)
        content = bytearray(path.read_bytes())
    elif how == "byte":
        content[at + 20] ^= 255
    elif how == "checksum":
        content[-13] ^= 255  # the last byte before IEND, whose 12 bytes are the end
    elif how == "cut":
        content = content[:-20]
    elif how in ("text", "empty"):
        content = bytearray(b"nothing of the kind" if how == "text" else b"")
    path.write_bytes(content)
    for read in (first, read_png16):
        with pytest.raises(StorageError, match=r"a\.png cannot be read as PNG"):
            read(path)


def test_a_large_png_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow refuses twice this number of pixels, whatever memory there is."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", PICTURE.size // 3)
    assert np.array_equal(first(png(tmp_path / "a.png")), PICTURE)


# --- what files say of their curve and colours -------------------------------------------------------------

SAYS = {
    "sRGB": (chunk(b"sRGB", b"\0"), "srgb"),
    "gAMA 1": (chunk(b"gAMA", struct.pack(">I", 100000)), "linear"),
    "gAMA 0.45": (chunk(b"gAMA", struct.pack(">I", 45455)), "gamma 2.2"),
    "cICP": (chunk(b"cICP", bytes([9, 16, 0, 1])), "PQ"),
}


@pytest.mark.parametrize("name", SAYS)
def test_a_png_says_its_curve(name: str, tmp_path: Path) -> None:
    extra, curve = SAYS[name]
    assert open_recording(png(tmp_path / "a.png", extra)).declared.curve == curve


def test_a_curve_that_is_not_the_stated_one_is_refused(tmp_path: Path) -> None:
    for k, frame in enumerate(codes16(signal())):
        raw = b"".join(b"\0" + row.astype(">u2").tobytes() for row in frame)
        png(tmp_path / f"{k}.png", SAYS["sRGB"][0], pixels=raw, rows=frame.shape[0], cols=frame.shape[1])
    with pytest.raises(ConfigError, match=r"linearisation: got 'linear', but 0.png says .* curve srgb"):
        truth(tmp_path, full_scale=65535).check()
    slots(truth(tmp_path, full_scale=65535, linearisation="srgb"), tmp_path)
    (clip,) = open_clips([tmp_path], patch=4, slots=8)
    assert clip.source.linearisation == "srgb"
    with pytest.raises(ConfigError, match="--linearisation: got 'linear'"):
        open_clips([tmp_path], linearisation="linear", patch=4, slots=8)
    with pytest.raises(ValueCheckError, match=r"image: .* follow the curve srgb"):
        read_measurement(MeasurementFiles(image=str(tmp_path / "0.png"), code=str(tmp_path)))


def test_luminance_of_other_primaries_is_not_bt709s(tmp_path: Path) -> None:
    rgb = dict.fromkeys("RGB", LIGHT)
    wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
    plain = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
    assert open_recording(exr(tmp_path / "a.exr", rgb)).declared == FileStatement()
    assert open_recording(exr(tmp_path / "a.exr", rgb, chromaticities=plain)).declared.primaries == "BT.709"
    exr(tmp_path / "a.exr", rgb, chromaticities=wide)
    with pytest.raises(
        ConfigError, match=r"channel_weights: got 'rec709', but a.exr .* red at \(0.708, 0.292\)"
    ):
        truth(tmp_path / "a.exr", channel_weights="rec709").source.check_declared(
            open_recording(tmp_path / "a.exr").declared, "a.exr"
        )


# --- raw counts ---------------------------------------------------------------------------------------------

COUNTS = np.random.default_rng(3).integers(0, 4096, (8, 9)).astype(np.uint16)


def dng(path: Path, kind: int = 34892, *, first: int = 1, packed: bool = False, extra: object = ()) -> Path:
    """A DNG as converters write it: a thumbnail first, and the counts of 12 bits in a page below it."""
    version = [(50706, "B", 4, (1, 4, 0, 0), True), *tag(274, first)]
    with tifffile.TiffWriter(path) as writer:
        small = np.zeros((2, 3, 3), np.uint8)
        writer.write(small, photometric="rgb", subifds=1, subfiletype=1, metadata=None, extratags=version)
        said = {"photometric": "minisblack", "subfiletype": 0, "metadata": None}
        bits = {"bitspersample": 12} if packed else {}
        writer.write(COUNTS, **said, **bits, extratags=[(50714, "H", 1, 64, True), *extra])
    with tifffile.TiffFile(path) as opened:
        at = opened.pages[0].pages[0].tags[262].valueoffset
    # The library writes no LinearRaw of one sample.
    content = bytearray(path.read_bytes())
    content[at : at + 2] = kind.to_bytes(2, "little")
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("packed", [True, False])
def test_counts_of_twelve_bits_are_read_as_the_sensor_took_them(packed: bool, tmp_path: Path) -> None:
    bits = {"bitspersample": 12} if packed else {}
    grey = tif(tmp_path / "a.tif", COUNTS, photometric="minisblack", **bits)
    assert np.array_equal(read_words(grey), COUNTS)
    assert np.array_equal(first(grey), COUNTS)
    raw = dng(tmp_path / "a.dng", packed=packed)
    assert np.array_equal(read_words(raw), COUNTS)
    np.savez(tmp_path / "code.npz", code=np.ones((2, *COUNTS.shape)))
    files = MeasurementFiles(image=str(raw), code=str(tmp_path / "code.npz"))
    assert np.array_equal(read_measurement(files).frames[0].dn, COUNTS)


@pytest.mark.parametrize(
    ("stated", "text"),
    [
        ({"kind": 32803}, "PhotometricInterpretation says CFA"),
        ({"first": 6}, "Orientation"),
        ({"extra": [(50712, "H", 2, (0, 9), True)]}, "LinearizationTable"),
        ({"extra": [(50829, "I", 4, (0, 1, 8, 9), True)]}, "ActiveArea"),
    ],
)
def test_a_dng_whose_numbers_are_no_counts_of_all_pixels_is_refused(
    stated: dict[str, object], text: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueCheckError, match=text):
        read_words(dng(tmp_path / "a.dng", **stated))


def test_raw_counts_are_no_footage(tmp_path: Path) -> None:
    for k in range(36):
        dng(tmp_path / f"{k:02d}.dng")
    with pytest.raises(ConfigError, match=r"raw counts of DNG; cure: convert"):
        open_clips([tmp_path])
    (tmp_path / "code").mkdir()
    np.savez(tmp_path / "code" / "code.npz", code=np.ones((2, *COUNTS.shape)))
    files = {"image": str(tmp_path / "00.dng"), "code": str(tmp_path / "code" / "code.npz")}
    with pytest.raises(ValueCheckError, match=r"truth: .*raw counts of DNG"):
        read_measurement(MeasurementFiles(**files, truth=str(tmp_path / "00.dng")))


def test_packed_bits_name_the_package_that_unpacks_them(tmp_path: Path, monkeypatch) -> None:
    path = tif(tmp_path / "a.tif", COUNTS, photometric="minisblack", bitspersample=12)

    def missing(*_: object, **__: object) -> None:
        raise NotImplementedError("packints_decode of 12-bit integers requires the 'imagecodecs' package")

    monkeypatch.setattr(tifffile.TiffPage, "asarray", missing)
    with pytest.raises(StorageError, match=r"12 bits a sample.*pip install 'optsim\[raw\]'"):
        read_words(path)
