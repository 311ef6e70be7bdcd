"""Mesh files that a scene names: faces and vertices are there, or one message names file and place."""

import struct
import zlib

import numpy as np
import pytest

from optsim.core.errors import StorageError
from optsim.scene.mesh_files import check_mesh

SQUARE = [(-1, 3, 0), (1, 3, 0), (1, 3, 2), (-1, 3, 2)]


def header(form, n_vertices, n_faces, index="int", length="uchar", name="vertex_indices"):
    return (
        f"ply\nformat {form} 1.0\ncomment made by a test\nelement vertex {n_vertices}\n"
        "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
        f"element face {n_faces}\nproperty uchar flags\nproperty list {length} {index} {name}\nend_header\n"
    )


def ascii_ply(faces, vertices=SQUARE):
    rows = [" ".join(map(str, (*vertex, 7))) for vertex in vertices]
    rows += [" ".join(map(str, (1, len(face), *face))) for face in faces]
    return (header("ascii", len(vertices), len(faces)) + "\n".join(rows) + "\n").encode()


def binary_ply(faces, vertices=SQUARE, order="<", index=("int", "i4"), length=("uchar", "u1")):
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    body = b"".join(np.array(v, order + "f4").tobytes() + b"\x07" for v in vertices)
    for face in faces:
        body += b"\x01" + np.array([len(face)], order + length[1]).tobytes()
        body += np.array(face, order + index[1]).tobytes()
    return header(form, len(vertices), len(faces), index[0], length[0], "vertex_index").encode() + body


def big_endian(faces, vertices=SQUARE):
    return binary_ply(faces, vertices, ">", ("uint", "u4"), ("int", "i4"))


def serialized(faces, vertices=SQUARE, *, version=4, flags=0x1000, counts=None, listed=None, cut=0, meshes=1):
    """Build a file as Mitsuba's documentation lays it out: meshes alike, then where each begins."""
    n_vertices, n_faces = counts or (len(vertices), len(faces))
    further = sum(n for flag, n in ((1, 3), (2, 2), (8, 3)) if flags & flag)
    numbers = [*np.ravel(vertices), *[0.5] * (further * len(vertices))]
    body = struct.pack("<I", flags) + (b"name\0" if version == 4 else b"")
    body += (
        struct.pack("<QQ", n_vertices, n_faces)
        + np.array(numbers, "<f8" if flags & 0x2000 else "<f4").tobytes()
    )
    packed = zlib.compress(body + np.array(faces, "<u4").tobytes())
    one = struct.pack("<HH", 0x041C, version) + packed[: len(packed) - cut]
    starts = [len(one) * k for k in range(meshes)] if listed is None else listed
    return (
        one * meshes
        + np.array(starts, "<u8" if version == 4 else "<u4").tobytes()
        + struct.pack("<I", len(starts))
    )


@pytest.fixture
def checked(tmp_path):
    def check(content, name="m.ply"):
        (tmp_path / name).write_bytes(content)
        check_mesh(tmp_path / name)

    return check


@pytest.mark.parametrize("write", [ascii_ply, binary_ply, big_endian])
def test_triangles_and_quads_mixed_are_fine_and_a_last_index_too_high_is_named(write, checked):
    faces = [(0, 1, 2), (0, 1, 2, 3), (0, 2, 3)] * 100
    checked(write(faces))
    for wrong in ((0, 2, 4), (0, 1, 2, 4)):
        with pytest.raises(StorageError, match=r"m\.ply names vertex 4 of 4, expected 0 to 3"):
            checked(write([*faces, wrong]))
    for faces, said in (([], "no faces"), ([(0, 1)], "a face has 2 corners")):
        with pytest.raises(StorageError, match=rf"m\.ply.*{said}"):
            checked(write(faces))
    with pytest.raises(StorageError, match=r"m\.ply: vertex 2 of 4 is not finite"):
        checked(write([(0, 1, 3)], [*SQUARE[:2], (0, float("nan"), 0), SQUARE[3]]))


def test_a_ply_by_another_name_is_one(checked):
    with pytest.raises(StorageError, match=r"m\.mesh names vertex 4 of 4"):
        checked(ascii_ply([(0, 2, 4)]), "m.mesh")
    checked(b"anything else", "m.mesh")


def test_a_negative_index_is_named(checked):
    for write in (ascii_ply, binary_ply):
        with pytest.raises(StorageError, match=r"names vertex -1 of 4"):
            checked(write([(0, 1, -1)]))


@pytest.mark.parametrize("write", [ascii_ply, binary_ply])
@pytest.mark.parametrize("cut", [1, 5, 40, 150, 300])
def test_a_truncated_file_is_named(write, cut, checked):
    content = write([(0, 1, 20), (0, 2, 3)], SQUARE * 6)
    cut = max(cut, 2) if write is ascii_ply else cut  # the last line break may go
    with pytest.raises(StorageError, match=r"m\.ply.*(cannot be read as a mesh \(PLY\)|no faces)"):
        checked(content[:-cut])


def test_what_is_no_ply_is_named(checked):
    for content in (b"", b"hello", b"ply\nformat ascii 1.0\n", b"ply\nformat odd 1.0\nend_header\n"):
        with pytest.raises(StorageError, match=r"m\.ply.*mesh \(PLY\)"):
            checked(content)


def test_an_obj_counts_from_one_or_back(checked):
    start = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    checked((start + "f 1/1 2//2 3/1/1\nf -1 -2 -3\n").encode(), "m.obj")
    for face, named in (("1 2 4", 3), ("0 1 2", -1), ("-4 1 2", -1)):
        with pytest.raises(StorageError, match=rf"m\.obj names vertex {named} of 3"):
            checked(f"{start}f {face}\n".encode(), "m.obj")
    for text, said in (
        (start, "got no faces"),
        ("", "got no faces"),
        (f"{start}f 1 2\n", "a face has 2 corners"),
    ):
        with pytest.raises(StorageError, match=rf"m\.obj.*{said}"):
            checked(text.encode(), "m.obj")
    with pytest.raises(StorageError, match=r"vertex 1 of 2 is not finite"):
        checked(b"v 0 0 0\nv nan 0 0\n", "m.obj")


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("flags", [0, 0x1000, 0x2000, 0x1001, 0x200B])
def test_a_serialized_mesh_is_read_whatever_its_numbers(version, flags, checked):
    """The last index decides: were the layout taken otherwise, it would be found elsewhere."""
    for faces, wrong in (([(0, 1, 2), (0, 2, 3)], None), ([(0, 1, 2), (0, 2, 4)], 4)):
        content = serialized(faces, version=version, flags=flags, meshes=2)
        if wrong is None:
            checked(content, "m.serialized")
        else:
            with pytest.raises(StorageError, match=r"m\.serialized names vertex 4 of 4"):
                checked(content, "m.serialized")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no serialized mesh"),
        (b"hello world, no mesh", "no serialized mesh"),
        (serialized([]), "got no faces"),
        (serialized([(0, 1, 2)], counts=(4, 50)), "cannot be read"),
        (serialized([(0, 1, 2)], counts=(4, 2**40)), "1099511627776 faces, more than"),
        (serialized([(0, 1, 2)], counts=(2**62, 1)), "4611686018427387904 vertices"),
        (serialized([(0, 1, 2)], counts=(0, 1)), "names vertex"),
        (serialized([(0, 1, 2)], listed=[2**40]), "no serialized mesh"),
        (serialized([(0, 1, 2)], listed=[]), "holds 0 meshes"),
        (serialized([(0, 1, 2)])[:-4] + b"\xff\xff\xff\xff", "holds 4294967295 meshes"),
        (serialized([(0, 1, 2)], cut=20), "cannot be read"),
        (serialized([(0, 1, 2)])[:-20], "cannot be read"),
        (serialized([(0, 1, 2)], [(float("nan"), 0, 0), *SQUARE[1:]]), "vertex 0 of 4 is not finite"),
    ],
)
def test_a_damaged_serialized_mesh_is_named(content, said, checked):
    with pytest.raises(StorageError, match=rf"m\.serialized.*({said})"):
        checked(content, "m.serialized")


def test_stl_is_refused(checked):
    for content in (b"solid a\nendsolid a\n", bytes(84), b""):
        with pytest.raises(
            StorageError, match=r"m\.STL: got an STL mesh, expected PLY or OBJ; cure: convert"
        ):
            checked(content, "m.STL")
