"""OBJ with MTL, PLY and STL as programs write them: faces, materials and colours are the file's own."""

import struct
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from optsim.core.errors import OptsimError
from optsim.scene import load_scene
from optsim.scene.models import read_model

V = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
VT = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
HEAD = """
name = "x"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 0]
target_m = [0, 0, 0]
[materials.grey]
[lamps.a]
center_m = [0, -1, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 8.0
"""


def written(folder, content, name="m.obj"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def areas(model):
    """Signed area along z of each part, and the area of all triangles."""
    crosses = [
        np.cross(*(mesh.vertices_m[mesh.faces][:, k] - mesh.vertices_m[mesh.faces][:, 0] for k in (1, 2)))
        for _, mesh in model.parts
    ]
    return sum(c[:, 2].sum() / 2 for c in crosses), sum(np.linalg.norm(c, axis=1).sum() / 2 for c in crosses)


def load(folder, name="m.obj", more=""):
    (folder / "scene.toml").write_text(
        f'{HEAD}[objects.it]\nkind = "mesh"\nfile = "{name}"\nup = "z"\nunit = "m"\n{more}'
    )
    return load_scene(folder)


L = [(0, 3), (0, 0), (3, 0), (3, 1), (1, 1), (1, 3)]
STAR = [(np.cos(a) * r, np.sin(a) * r) for k in range(5) for a, r in ((1.26 * k, 1), (1.26 * k + 0.63, 0.3))]


def ply(points, faces, **columns):
    names = [name for name in columns if name != "face"]
    kinds = ["uchar" if np.asarray(columns[name]).dtype.kind == "i" else "float" for name in names]
    text = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    text += "".join(f"property float {axis}\n" for axis in "xyz")
    text += "".join(f"property {kind} {name}\n" for kind, name in zip(kinds, names, strict=True))
    text += f"element face {len(faces)}\nproperty list uchar int vertex_indices\n"
    shades = columns.get("face")
    text += "" if shades is None else "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = [[*point, *(columns[name][k] for name in names)] for k, point in enumerate(points)]
    rows += [[len(face), *face, *([] if shades is None else shades[k])] for k, face in enumerate(faces)]
    return text + "end_header\n" + "\n".join(" ".join(map(str, row)) for row in rows) + "\n"


@pytest.mark.parametrize("outline", [L, L[::-1], L[3:] + L[:3], STAR, [(0, 0), (2, 0), (2, 2), (1, 0.5)]])
@pytest.mark.parametrize("tilt", [0.0, 1.1])
def test_faces_that_are_not_convex_are_covered_once(tmp_path, outline, tilt):
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    points = np.column_stack([outline, np.zeros(len(outline))]) @ turn.T
    x, y = np.array(outline, float).T
    shoelace = (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2
    lines = [f"v {p[0]} {p[1]} {p[2]}" for p in points]
    lines.append("f " + " ".join(map(str, range(1, len(points) + 1))))
    for path in (
        written(tmp_path, "\n".join(lines)),
        written(tmp_path, ply(points.tolist(), [range(len(points))]), "m.ply"),
    ):
        signed, whole = areas(read_model(path))
        assert whole == pytest.approx(abs(shoelace), rel=1e-6)
        # Winding stays.
        assert signed == pytest.approx(shoelace * np.cos(tilt), rel=1e-6)


def test_a_face_that_crosses_itself_is_said(tmp_path):
    written(tmp_path, "v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.warns(UserWarning, match=r"m\.obj: left out: the outline of 1 faces that cross themselves"):
        load(tmp_path)


@pytest.mark.parametrize(
    ("text", "triangles", "area"),
    [
        (V + "f -4 -3 -2 -1\n", 2, 1),
        (V + "f 1 2 \\\n3 4\n", 2, 1),
        (V.replace(" 0\n", " 0 1.0\n") + "f 1 2 3 4\n", 2, 1),
        ((V + "f 1 2 3 4\n").replace("\n", "\r\n"), 2, 1),
        ((V + "f 1 2 3 4\n").replace("\n", "\r"), 2, 1),
        ((V + "f 1 2 3 4\n").replace(" ", "\t"), 2, 1),
        ("\ufeff" + V + "f 1 2 3 4\n", 2, 1),
        ("f 1 2 3 4\n" + V, 2, 1),
        (V + VT + "vn 0 0 1\nf 1//1 2//1 3//1\nf 1/1 3/1 4/1\nf 1/1/1 3/1/1 4/1/1\n", 3, 1.5),
        ("v 9 9 9\n" + V + "f -4 -3 -2\nv 2 2 0\nf -2 -5 -4\n", 2, 1.0),
        (("# Kugel aus München\x85\n" + V + "f 1 2 3 4\n").encode("latin-1"), 2, 1),
        (("# Ω\n" + V + "f 1 2 3 4\n").encode("utf-16"), 2, 1),
        (b"\xfe\xff" + (V + "f 1 2 3 4\n").encode("utf-16-be"), 2, 1),
        (V + "f 1 2 3 4 # the lot\n#f 1 2 3\n", 2, 1),
        ("# from C:\\models\\\n" + V + "f 1 2 3 4\n", 2, 1),
        ((V + "f 1 2 3 4\n").encode("utf-16-le"), 2, 1),
        ((V + "f 1 2 3 4\n").encode("utf-16-be"), 2, 1),
    ],
)
def test_obj_text_of_every_kind_is_read(tmp_path, text, triangles, area):
    found = read_model(written(tmp_path, text))
    assert sum(len(mesh.faces) for _, mesh in found.parts) == triangles
    assert areas(found)[1] == pytest.approx(area)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (V + "f 0 1 2\n", r"m\.obj: got a face with vertex -1, expected 0 to 3"),
        (V + "f 1 2 9\n", r"got a face with vertex 8, expected 0 to 3"),
        (V + "f -5 1 2\n", r"got a face with vertex -1, expected 0 to 3"),
        (V + "vt 0 0\nf 1/1 2/2 3/1\n", r"got a face with texture coordinate 1, expected 0 to 0"),
        (V + "vt 0 0\nf 1/1 2/-2 3/1\n", r"got a face with texture coordinate -2, expected 0 to 0"),
        ("v 0,0 0,0 0\n", r"m\.obj: line 1: got 'v 0,0 0,0 0', expected numbers"),
        (V + "f 1 2 x\n", r"a face has the corner 'x', expected whole numbers"),
        (V + "f 1 2 3.5\n", r"a face has the corner '3\.5', expected whole numbers"),
        (V + "f 1 2\nf\n", r"got no triangles \(2 faces of less than 3 corners\)"),
        ("v 0 0\n", r"line 1: got 'v 0 0', expected numbers"),
        (V + "curv2 1 2\nf 1 2 3\n", r"line 5: got 'curv2 1 2', which is not read; export polygons"),
        (V + "l 1 2\n", r"got no triangles \(l\), expected a mesh"),
        (V.replace("v 0 0 0", "v nan 0 0") + "f 1 2 3\n", "got a vertex that is not finite"),
    ],
)
def test_a_bad_obj_is_said_in_a_line(tmp_path, text, message):
    with pytest.raises(OptsimError, match=message) as caught:
        read_model(written(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_smoothing_groups_and_normals_decide_what_is_shared(tmp_path):
    roof = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 0 1\n"
    for text, count in (
        ("f 1 2 3\nf 2 1 4\n", 4),
        ("s 1\nf 1 2 3\nf 2 1 4\n", 4),
        ("s off\nf 1 2 3\nf 2 1 4\n", 6),
        ("s 1\nf 1 2 3\ns 2\nf 2 1 4\n", 6),
        ("vn 0 0 1\nvn 0 1 0\nf 1//1 2//1 3//1\nf 2//2 1//2 4//2\n", 6),
        ("vn 0 0 1\nf 1//-1 2//-1 3//-1\nvn 0 1 0\nf 2//-1 1//-1 4//-1\n", 6),
    ):
        assert len(read_model(written(tmp_path, roof + text)).parts[0][1].vertices_m) == count, text


def material(folder, text, library="mtllib m.mtl\n"):
    """Surface and mesh of a square with it."""
    written(folder, text, "m.mtl")
    written(folder, f"{library}{V}{VT}usemtl my paint\nf 1/1 2/2 3/3 4/4\n")
    ((surface, mesh),) = read_model(folder / "m.obj").parts
    return surface, mesh


@pytest.fixture
def painted(tmp_path):
    (tmp_path / "tex").mkdir()
    for name in ("t.png", "my  wood.png", "tex/t.png", "50% grey.png"):
        Image.new("RGBA", (4, 4), (188, 188, 188, 102)).save(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize(
    ("stated", "matrix", "wrap"),
    [
        ("map_Kd t.png", (1, 1, 0, 0), "repeat"),
        ("Map_Kd\tt.png ", (1, 1, 0, 0), "repeat"),
        ("map_Kd t.png # wood", (1, 1, 0, 0), "repeat"),
        ("map_Kd my  wood.png", (1, 1, 0, 0), "repeat"),
        ('map_Kd "my  wood.png"', (1, 1, 0, 0), "repeat"),
        ("map_Kd tex\\t.png", (1, 1, 0, 0), "repeat"),
        ("map_Kd .\\tex\\t.png", (1, 1, 0, 0), "repeat"),
        ("map_Kd 50% grey.png", (1, 1, 0, 0), "repeat"),
        ("map_Kd 50%25%20grey.png", (1, 1, 0, 0), "repeat"),
        ("map_Kd -s 2 3 1 t.png", (2, 3, 0, 0), "repeat"),
        ("map_Kd -s 2 t.png", (2, 1, 0, 0), "repeat"),
        ("map_Kd -o .25 .5 -s 2 2 2 my  wood.png", (2, 2, 0.25, 0.5), "repeat"),
        ("map_Kd -mm 0 1 -t 0 0 0 t.png", (1, 1, 0, 0), "repeat"),
        ("map_Kd -clamp on t.png", (1, 1, 0, 0), "clamp"),
        ("map_Kd -clamp off -s 1 1 1 t.png", (1, 1, 0, 0), "repeat"),
    ],
)
def test_a_picture_lies_as_its_options_say(painted, stated, matrix, wrap):
    surface, mesh = material(painted, f"newmtl my paint\nKd 1 1 1\n{stated}\n")
    np.testing.assert_allclose(surface.picture, 0.5028865, atol=1e-5)
    wide, high, right, up = matrix
    expected = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (wide, high) + (right, up)
    np.testing.assert_allclose(mesh.uv, expected)
    assert (surface.wrap, surface.lost, surface.refused) == (wrap, "", "")
    assert load(painted).materials["it"].picture == str(painted / "m.obj")


@pytest.mark.parametrize(
    ("text", "colour", "opacity", "roughness", "metallic"),
    [
        ("Kd 0.5 0.25 0.0019", (0.5, 0.25, 0.0019), 1, 1, 0),
        ("Kd 0.5", (0.5, 0.5, 0.5), 1, 1, 0),
        ("Ka 1 1 1", (0.5, 0.5, 0.5), 1, 1, 0),
        ("Kd 0 1 0\nd 0.25", (0, 1, 0), 0.25, 1, 0),
        ("Kd 0 1 0\nTr 0.75", (0, 1, 0), 0.25, 1, 0),
        # The slope of facets is the square of the roughness: 0.0447 of an exponent of 1000.
        ("Kd 0 1 0\nKs 1 1 1\nNs 1000", (0, 1, 0), 1, np.sqrt(np.sqrt(2 / 1002)), 0),
        ("Kd 0 1 0\nKs 0 0 0\nNs 1000", (0, 1, 0), 1, 1, 0),
        ("Kd 0 1 0\nillum 1\nNs 1000", (0, 1, 0), 1, 1, 0),
        ("Kd 0 1 0\nPr 0.3\nPm 0.75", (0, 1, 0), 1, 0.3, 0.75),
    ],
)
def test_numbers_of_a_material_are_the_files(tmp_path, text, colour, opacity, roughness, metallic):
    surface, _ = material(tmp_path, f"newmtl my paint\n{text}\n")
    np.testing.assert_allclose(surface.colour, colour)
    got = (surface.opacity, surface.roughness, surface.metallic)
    np.testing.assert_allclose(got, (opacity, roughness, metallic))


@pytest.mark.parametrize(
    "library", ["mtllib n.mtl m.mtl\n", "mtllib n.mtl\nmtllib m.mtl\n", "mtllib m.mtl\nmtllib n.mtl\n"]
)
def test_all_libraries_count(tmp_path, library):
    written(tmp_path, "newmtl other\nKd 0 0 1\n", "n.mtl")
    surface, _ = material(tmp_path, "newmtl my paint\n# grün\nKd 0 1 0\n".encode("latin-1"), library)
    np.testing.assert_array_equal(surface.colour, [0, 1, 0])


def test_a_changed_picture_behind_options_is_another_scene(painted):
    seen = set()
    for grey in (188, 10):
        Image.new("RGB", (4, 4), (grey,) * 3).save(painted / "my  wood.png")
        material(painted, "newmtl my paint\nmap_Kd -s 2 2 my  wood.png\n")
        seen.add(load(painted).model_dump_json())
    assert len(seen) == 2


def test_a_turned_or_moving_picture_lies_as_it_is_stored_which_is_said(painted):
    exif = Image.Exif()
    exif[274] = 6
    Image.new("RGB", (4, 2), (188,) * 3).save(painted / "turned.jpg", exif=exif)
    frames = [Image.new("L", (4, 2), grey) for grey in (188, 10)]
    frames[0].save(painted / "moves.gif", save_all=True, append_images=frames[1:])
    for name, said in (
        ("turned.jpg", "EXIF orientation 6 of a picture"),
        ("moves.gif", "pictures of an anim"),
    ):
        surface, _ = material(painted, f"newmtl my paint\nmap_Kd {name}\n")
        assert surface.picture.shape == (2, 4, 3)
        with pytest.warns(UserWarning, match=f"left out: {said}"):
            load(painted)


@pytest.mark.parametrize("where", ["mats/wood.png", "wood.png"])
def test_a_picture_lies_beside_its_library_or_beside_the_model(tmp_path, where):
    (tmp_path / "mats").mkdir()
    Image.new("RGB", (4, 4), (188,) * 3).save(tmp_path / where)
    written(tmp_path, "newmtl my paint\nmap_Kd wood.png\n", "mats/m.mtl")
    surface, _ = material(tmp_path, "", "mtllib mats\\m.mtl\n")
    np.testing.assert_allclose(surface.picture, 0.5028865, atol=1e-5)
    before = load(tmp_path).model_dump_json()
    Image.new("RGB", (4, 4), (10,) * 3).save(tmp_path / where)
    assert load(tmp_path).model_dump_json() != before


def test_maps_of_a_material_are_read(painted):
    Image.new("RGB", (4, 4), (128, 128, 255)).save(painted / "n.png")
    text = "newmtl my paint\nmap_Kd t.png\nmap_d t.png\nnorm n.png\nmap_Pr tex/t.png\n"
    surface, _ = material(painted, text)
    assert sorted(surface.maps) == ["normal_map", "roughness_map"]
    np.testing.assert_allclose(surface.cutout, 0.4)
    np.testing.assert_allclose(surface.maps["roughness_map"], 188 / 255)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        (
            "Kd spectral x.rfl 1",
            r"material 'my paint': got Kd 'spectral x\.rfl 1', expected one or three numbers",
        ),
        ("Kd 1 1 1\nd half", r"got d 'half', expected a number"),
        ("map_Kd -mm 0.2 0.5 t.png", r"map_kd: got -mm 0\.2 0\.5, which is not read"),
        ("map_Kd -s 2 2 t.png\nmap_d t.png", "pictures that lie differently"),
        ("map_Kd m.mtl", r"map_kd: got no PNG, JPEG, .* or a damaged one"),
        ("map_Kd none.png", r"m\.obj names 'none\.png', but there is no such file"),
        ("map_Kd ../none.png", r"m\.obj names '\.\./none\.png', expected a file inside"),
    ],
)
def test_what_a_surface_cannot_show_is_refused_unless_it_has_another(painted, stated, message):
    material(painted, f"newmtl my paint\n{stated}\n")
    with pytest.raises(OptsimError, match=message) as caught:
        load(painted)
    assert "\n" not in str(caught.value)
    if ".." not in stated:
        assert load(painted, more='material = "grey"\n').objects["it"].material == "grey"


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ("Kd 1 1 1\nKe 0 2 0", "ke"),
        ("Kd 1 1 1\nbump t.png", "bump"),
        ("Kd 1 1 1\nTf 0.5 1 1", "tf"),
        ("d -halo 0.5", "d -halo"),
        ("Kd 0 0 0\nmap_Kd t.png", "map_kd, which Kd 0 makes black"),
        ("map_Kd -blendu off t.png", "map_kd -blendu"),
        ("Kd 2 1 1", r"a colour or number beyond 0 to 1 \(clipped\)"),
    ],
)
def test_what_a_material_states_beyond_is_said(painted, stated, said):
    material(painted, f"newmtl my paint\n{stated}\n")
    with pytest.warns(UserWarning, match=rf"m\.obj: left out: {said}"):
        load(painted)


def test_what_states_nothing_is_not_said_and_an_unknown_material_is(tmp_path):
    material(tmp_path, "newmtl my paint\nKa 0 0 0\nKd 1 1 1\nKe 0 0 0\nTf 1 1 1\nNi 1.45\nillum 2\n")
    load(tmp_path)
    material(tmp_path, "newmtl other\nKd 1 0 0\n")
    with pytest.warns(UserWarning, match="left out: material 'my paint', which no library has"):
        load(tmp_path)


def test_a_model_without_a_material_is_the_same_grey_with_and_without_coordinates(tmp_path):
    seen = []
    for text in ("f 1 2 3\n", VT + "f 1/1 2/2 3/3\n"):
        surface = read_model(written(tmp_path, V + text)).parts[0][0]
        seen.append((surface.colour.tolist(), surface.picture, surface.roughness))
    assert seen[0] == seen[1] == ([0.5] * 3, None, 1.0)


COLOURS = {"red": [255, 0, 10, 10], "green": [255, 0, 0, 0], "blue": [255, 0, 0, 0]}


def test_colours_at_vertices_are_srgb_and_equal_ones_are_the_surfaces(tmp_path):
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
    dark = 10 / 255 / 12.92
    expected = [[1, 1, 1], [0, 0, 0], [dark, 0, 0], [dark, 0, 0]]
    named = {f"diffuse_{name}": column for name, column in COLOURS.items()}
    shares = {name: (np.array(column) / 255).tolist() for name, column in COLOURS.items()}
    for columns in (COLOURS, named, shares):
        written(tmp_path, ply(points, [(0, 1, 2, 3)], **columns), "m.ply")
        ((surface, mesh),) = read_model(tmp_path / "m.ply").parts
        np.testing.assert_allclose(mesh.colours, expected, atol=1e-6)
        np.testing.assert_array_equal(surface.colour, 1)
    assert load(tmp_path, "m.ply").materials["it"].vertex_colours
    assert (
        not load(tmp_path, "m.ply", 'material = "grey"\n')
        .materials["grey"]
        .model_dump()
        .get("vertex_colours")
    )
    for scale, form in ((1 / 255, "%.6f"), (1, "%d")):
        rows = [
            f"v {p[0]} {p[1]} {p[2]} " + " ".join(form % (COLOURS[name][k] * scale) for name in COLOURS)
            for k, p in enumerate(points)
        ]
        ((_, mesh),) = read_model(written(tmp_path, "\n".join([*rows, "f 1 2 3 4\n"]))).parts
        np.testing.assert_allclose(mesh.colours, expected, atol=1e-5)
    equal = {name: [188] * 4 for name in COLOURS}
    ((surface, mesh),) = read_model(written(tmp_path, ply(points, [(0, 1, 2, 3)], **equal), "m.ply")).parts
    assert mesh.colours is None
    np.testing.assert_allclose(surface.colour, 0.5028865, atol=1e-6)


def test_a_flat_model_has_no_height_to_be_scaled_to(tmp_path):
    written(tmp_path, "v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    load(tmp_path)
    population = (
        'count = [1, 1]\nregion_m = [[0, 0, 0], [1, 1, 1]]\nsize_m = [0.1, 0.2]\nmodels = ["m.obj"]\n'
    )
    (tmp_path / "scene.toml").write_text(f'{HEAD}[populate.p]\n{population}up = "z"\n')
    with pytest.raises(OptsimError, match="a model without a height; cure: another model, or another up"):
        load_scene(tmp_path)
    (tmp_path / "scene.toml").write_text(f'{HEAD}[populate.p]\n{population}up = "x"\n')
    load_scene(tmp_path)


@pytest.mark.parametrize("bad", ["0 0 -1", "0 1.2 0", "0 nan 0", "0.5 0 255"])
def test_colours_beyond_their_range_are_refused_unless_the_scene_has_a_material(tmp_path, bad):
    written(tmp_path, V.replace("\n", f" {bad}\n", 1) + "f 1 2 3\n")
    with pytest.raises(OptsimError, match=r"m\.obj: colours at vertices that are not 0 to 1, .*; cure: "):
        load(tmp_path)
    assert load(tmp_path, more='material = "grey"\n').objects["it"].material == "grey"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("v 0 0 0 1 0 0 1\n", "numbers of a vertex beyond place and colour"),
        ("#MRGB ffff0000\n", "#MRGB"),
        ("\0\0\n", "what is no text"),
    ],
)
def test_what_an_obj_has_beyond_is_said(tmp_path, text, said):
    written(tmp_path, V + text + "f 1 2 3\n")
    with pytest.warns(UserWarning, match=rf"m\.obj: left out: {said}$"):
        load(tmp_path)


def test_names_with_a_number_sign_and_japanese_ones_are_whole(tmp_path):
    written(tmp_path, "newmtl Material #25\nKd 1 0 0\nnewmtl Material #26\nKd 0 1 0\n", "m.mtl")
    text = f"mtllib m.mtl\ng ソ\n{V}usemtl Material #26\nf 1 2 3 #26\n"
    ((surface, mesh),) = read_model(written(tmp_path, text.encode("shift-jis"))).parts
    np.testing.assert_array_equal(surface.colour, [0, 1, 0])
    assert len(mesh.faces) == 1


def test_colours_of_faces_split_the_vertices_between_them(tmp_path):
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0)]
    faces, shades = [(0, 1, 2), (0, 2, 3), (1, 4, 2)], [(255, 0, 0), (255, 0, 0), (0, 0, 255)]
    path = written(
        tmp_path, ply(points, faces, face=shades, s=[0.0, 1.0, 1.0, 0.0, 2.0], t=[0.0] * 5), "m.ply"
    )
    ((_, mesh),) = read_model(path).parts
    assert len(mesh.vertices_m) == 7
    for face, shade, stated in zip(mesh.faces, shades, faces, strict=True):
        np.testing.assert_array_equal(mesh.vertices_m[face], np.array(points)[list(stated)])
        np.testing.assert_array_equal(mesh.colours[face], [np.array(shade) / 255] * 3)
        np.testing.assert_array_equal(mesh.uv[face, 0], np.array([0, 1, 1, 0, 2.0])[list(stated)])


def test_a_file_without_vertices_is_said(tmp_path):
    with pytest.raises(OptsimError, match=r"m\.ply: got no triangles"):
        read_model(written(tmp_path, ply([], []), "m.ply"))
    with pytest.raises(OptsimError, match=r"m\.obj: got no triangles"):
        read_model(written(tmp_path, "usemtl a\n"))
    with pytest.raises(OptsimError, match=r"m\.stl: got no triangles"):
        read_model(written(tmp_path, bytes(84), "m.stl"))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", " \n"])
def test_a_ply_ends_its_lines_in_any_way(tmp_path, end):
    text = ply([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)]).replace("\n", end)
    assert areas(read_model(written(tmp_path, text, "m.ply")))[1] == pytest.approx(0.5)


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
def test_texture_coordinates_of_a_ply_are_there_for_a_material_of_the_scene(tmp_path, names):
    points = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
    columns = dict(zip(names, ([0.0, 0.5, 0.5], [0.25, 0.25, 1.0]), strict=True))
    ((_, mesh),) = read_model(written(tmp_path, ply(points, [(0, 1, 2)], **columns), "m.ply")).parts
    np.testing.assert_array_equal(mesh.uv, [[0, 0.25], [0.5, 0.25], [0.5, 1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("element face 1", "element tristrips 1"), "got triangle strips, which are not read"),
        (("element face 1", "element edge 1"), "got no triangles"),
        (("element face 1", "element face 0"), "got no triangles"),
        (("property float x", "property float w"), "its vertices have no x, y and z"),
        (("3 0 1 2", "3 0 1 1.5"), "face vertex_indices holds what is no int"),
        (("256 0 0", "256 0 0"), r"vertex red holds what is no uchar"),
        (("3 0 1 2", "4 0 1 2"), "it ends after 0 of 1 rows of 'face'"),
    ],
)
def test_a_bad_ply_is_said_in_a_line(tmp_path, change, message):
    columns = {name: [256 if name == "red" else 0] * 3 for name in COLOURS}
    text = ply([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)], **columns)
    if "red" not in message and "256" not in message:
        text = text.replace("256", "255")
    with pytest.raises(OptsimError, match=rf"m\.ply.*{message}") as caught:
        read_model(written(tmp_path, text.replace(*change), "m.ply"))
    assert "\n" not in str(caught.value)


def test_what_a_ply_has_beyond_is_said(tmp_path):
    text = ply([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)], nx=[0.0] * 3, alpha=[255, 255, 0])
    written(tmp_path, text.replace("\nelement", "\ncomment TextureFile a.png\nelement", 1), "m.ply")
    said = r"a picture \(TextureFile\), vertex nx, vertex alpha"
    half = ply([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)], alpha=[128] * 3)
    written(tmp_path, half, "half.ply")
    with pytest.warns(UserWarning, match=r"half\.ply: left out: vertex alpha"):
        load(tmp_path, "half.ply")
    with pytest.warns(UserWarning, match=rf"m\.ply: left out: {said}"):
        load(tmp_path, "m.ply")


def test_a_remark_is_one_line_on_the_terminal(tmp_path):
    written(tmp_path, ply([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)], quality=[0.5] * 3), "m.ply")
    more = 'material = "grey"\n[ranges]\n"lamps.a.radiance_w_m2_sr" = [4.0, 5.0]\n'
    with pytest.warns(UserWarning, match="left out"):
        load(tmp_path, "m.ply", more)
    command = [sys.executable, "-m", "optsim", "run", "demo", "--dry-run", "--set", f"scene.name={tmp_path}/"]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stderr
    assert said.count("left out") == said.count("optsim: m.ply: left out: vertex quality\n") == 1


FACET = struct.pack("<12fH", *[0] * 3, *[0, 0, 0, 1, 0, 0, 0, 1, 0], 0)
TEXT = (
    "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    "endloop\nendfacet\nendsolid\n"
)


@pytest.mark.parametrize(
    ("content", "triangles"),
    [
        (b"solid, but binary".ljust(80) + struct.pack("<I", 2) + FACET * 2, 2),
        (TEXT.encode(), 1),
        ((TEXT.upper() + TEXT).encode(), 2),
    ],
)
def test_stl_is_binary_by_its_size_or_text(tmp_path, content, triangles):
    ((surface, mesh),) = read_model(written(tmp_path, content, "m.stl")).parts
    assert len(mesh.faces) == triangles
    np.testing.assert_array_equal(mesh.vertices_m[mesh.faces[-1]], [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(surface.colour, 0.5)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (bytes(80) + struct.pack("<I", 3) + FACET * 2, "184 bytes, expected 84 and 50 for each of 3 faces"),
        (TEXT[:-25].encode(), "it has 3 vertices, expected three for each facet"),
        (b"hello", "holds 5 bytes"),
    ],
)
def test_a_damaged_stl_is_said(tmp_path, content, message):
    with pytest.raises(OptsimError, match=message):
        read_model(written(tmp_path, content, "m.stl"))


def test_colours_in_an_stl_are_left_out_and_said(tmp_path):
    written(tmp_path, bytes(80) + struct.pack("<I", 1) + FACET[:-2] + b"\x01\x80", "m.stl")
    with pytest.warns(UserWarning, match=r"m\.stl: left out: colours of faces"):
        load(tmp_path, "m.stl")
