"""Bad input is explained before anything renders: the shapes file, materials, shapes without extent."""

import numpy as np
import pytest

from optsim.core.errors import ConfigError, StorageError
from optsim.scene import load_scene
from optsim.scene.scene import Scene
from optsim.scene.textures import PHOTOGRAPHS

HEAD = """
name = "x"
white_w_m2_sr = 1.0
static = "static.xml"
[camera]
position_m = [0, 0, 1]
target_m = [0, 4, 1]
[materials.grey]
[lamps.a]
center_m = [0, 0, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 2.0
"""
BALL = '<shape type="sphere"><float name="radius" value="0.5"/></shape>'


def xml(inside, version=' version="3.0.0"'):
    return f"<scene{version}>{inside}</scene>"


@pytest.fixture
def folder(tmp_path):
    def write(shapes=None, toml=HEAD):
        (tmp_path / "scene.toml").write_text(toml)
        if shapes is not None:
            (tmp_path / "static.xml").write_text(shapes)
        return tmp_path

    return write


def test_shapes_are_read_and_decide_the_dump(folder):
    scene = load_scene(folder(xml(BALL)))
    assert scene.static is not None
    assert BALL in scene.static.text
    other = load_scene(folder(xml(BALL.replace("0.5", "0.6"))))
    assert other.model_dump(mode="json") != scene.model_dump(mode="json")
    assert load_scene(folder(None, HEAD.replace('static = "static.xml"', ""))).static is None


def test_files_that_shapes_refer_to_decide_the_dump_and_the_folder_does_not(folder, tmp_path):
    mesh = '<shape type="obj"><string name="filename" value="a.obj"/></shape>'
    triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(triangle)
    first = load_scene(folder(xml(mesh)))
    assert str(tmp_path) in first.static.ready()
    assert str(tmp_path) not in first.model_dump_json()
    (tmp_path / "a.obj").write_text(triangle + "v 0 0 1\n")
    assert load_scene(tmp_path).model_dump(mode="json") != first.model_dump(mode="json")


def test_a_file_is_the_mesh_that_its_shape_says(folder, tmp_path):
    (tmp_path / "a.mesh").write_text("v 0 0 0\nf 1 2 3\n")
    shape = '<shape type="{}"><string name="filename" value="a.mesh"/></shape>'
    for kind, said in (
        ("obj", "names vertex 1 of 1"),
        ("serialized", "no serialized mesh"),
        ("stl", "PLY or OBJ"),
    ):
        with pytest.raises(StorageError, match=rf"a\.mesh.*{said}"):
            load_scene(folder(xml(shape.format(kind))))


def test_a_smaller_unit_scales_what_stands_in_the_scene():
    from xml.etree import ElementTree

    from optsim.scene.static_shapes import StaticShapes

    placed = '<shape type="cube"><transform name="to_world"><translate x="1"/></transform></shape>'
    group = '<shape type="shapegroup" id="g"><shape type="sphere"/></shape>'
    static = StaticShapes(name="s.xml", text=xml(BALL + placed + group))
    ball, cube, grouped = ElementTree.fromstring(static.ready(0.25)).findall("shape")
    assert [step.tag for step in cube.find("transform")] == ["translate", "scale"]
    assert [s.get("value") for s in (ball.find("transform/scale"), cube.find("transform/scale"))] == [
        "4.0"
    ] * 2
    assert grouped.find(".//scale") is None
    assert "scale" not in static.ready()


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (None, "static: got 'static.xml'.*put it there"),
        ("", "not valid XML"),
        (xml(BALL)[:-3], "not valid XML"),
        (xml(BALL, ""), 'expected <scene version="3.0.0">'),
        (BALL, 'expected <scene version="3.0.0">'),
        (xml(""), "no shape in it"),
        (xml('<bsdf type="diffuse" id="a"/>'), "no shape in it"),
        (xml('<shape type="shapegroup" id="g"><shape type="sphere"/></shape>'), "no shape in it"),
        (xml(BALL + '<sensor type="perspective"/>'), r"<sensor> is not allowed.*\[camera\]"),
        (xml(BALL + '<emitter type="constant"/>'), r"<emitter> is not allowed.*\[lamps\]"),
        (xml('<shape type="sphere"><emitter type="area"/></shape>'), r"<emitter> is not allowed.*\[lamps\]"),
        (xml(BALL + '<integrator type="path"/>'), "<integrator> is not allowed"),
        (xml(BALL + '<include filename="/etc/passwd"/>'), "<include> is not allowed"),
        (xml(BALL + '<shap type="sphere"/>'), "did you mean '<shape>'"),
        ('<!DOCTYPE a [<!ENTITY b "c">]>' + xml(BALL), "document type"),
        (xml('<shape type="sphere"><ref id="gery"/></shape>'), "unknown id in a <ref> 'gery'"),
        (xml('<bsdf type="diffuse" id="a"/><bsdf type="diffuse" id="a"/>' + BALL), "'a' is used twice"),
        (xml('<shape type="obj"><string name="filename" value="no.obj"/></shape>'), "'no.obj' is not in"),
        (xml('<shape type="obj"><string name="filename" value="../a.obj"/></shape>'), "inside the scene"),
        (xml('<shape type="obj"><string name="filename" value="/etc/passwd"/></shape>'), "inside the scene"),
    ],
)
def test_bad_shapes_are_explained(folder, shapes, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(folder(shapes))


@pytest.mark.parametrize("name", ["../static.xml", "sub/static.xml", "/etc/passwd", ""])
def test_the_shapes_file_lies_beside_the_scene(folder, name):
    with pytest.raises(ConfigError, match="static"):
        load_scene(folder(xml(BALL), HEAD.replace("static.xml", name)))


PLAIN = HEAD.replace('static = "static.xml"', "")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('kind = "plastik"', "plastic"),
        ('kind = "metal"\nmetal = "Fe"', "metal"),
        ('kind = "metal"\nreflectance = 0.5', "reflectance: unknown key"),
        ('kind = "glass"\nior = 0.9', "ior"),
        ('kind = "plastic"\nroughness = 0', "roughness"),
        ('kind = "plastic"\ntexture = "brik"', "brick"),
        ("roughness = 0.1", "roughness: unknown key"),
        ("reflectance = 1.1", "reflectance"),
    ],
)
def test_bad_materials_are_explained(folder, keys, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(folder(None, f"{PLAIN}[materials.odd]\n{keys}\n"))


def test_a_photograph_that_is_not_installed_is_missed_while_loading(folder, monkeypatch):
    monkeypatch.setitem(PHOTOGRAPHS, "brick", "no_such_brick.png")
    with pytest.raises(ConfigError, match=r"no_such_brick\.png is not in the installed scikit-image.*cure"):
        load_scene(folder(None, f'{PLAIN}[materials.odd]\ntexture = "brick"\n'))


def test_a_material_without_kind_is_diffuse(folder):
    scene = load_scene(folder(None, PLAIN + '[materials.gold]\nkind = "metal"\nmetal = "Au"\n'))
    assert {name: item.kind for name, item in scene.materials.items()} == {"grey": "diffuse", "gold": "metal"}
    # A dump is a scene again: the kinds survive.
    assert Scene.model_validate(scene.model_dump()) == scene


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('kind = "quad"\ncorner_m = [0, 0, 0]\nedge_u_m = [1, 0, 0]\nedge_v_m = [2, 0, 0]', "parallel"),
        ('kind = "quad"\ncorner_m = [0, 0, 0]\nedge_u_m = [1, 0, 0]\nedge_v_m = [0, 0, 0]', "zero"),
        ('kind = "wall"\ncorner_m = [0, 0, 0]\nedge_u_m = [1, 0, 0]\nedge_v_m = [1, 0, 1]', "orthogonal"),
        ('kind = "rod"\nstart_m = [0, 0, 1]\nstop_m = [0, 0, 1]\nradius_m = 0.1', "use a globe"),
        ('kind = "globe"\ncenter_m = [0, 0, 1]\nradius_m = 0', "radius_m"),
        ('kind = "globe"\ncenter_m = [0, 0, inf]\nradius_m = 1', "center_m.2.*finite"),
        ('kind = "pyramid"', "kind: got 'pyramid', expected one of: quad, box"),
    ],
)
def test_objects_without_extent_are_refused(folder, keys, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(folder(None, f'{PLAIN}[objects.o]\nmaterial = "grey"\n{keys}\n'))


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_scenes_of_a_millimetre_and_a_kilometre_are_welcome(folder, scale):
    toml = PLAIN.replace("[1, 0, 0]", f"[{scale}, 0, 0]").replace("[0, -1, 0]", f"[0, {-scale}, 0]")
    quad = f"corner_m = [0, 0, 0]\nedge_u_m = [{scale}, 0, 0]\nedge_v_m = [0, 0, {scale}]\n"
    scene = load_scene(folder(None, f'{toml}[objects.o]\nkind = "quad"\nmaterial = "grey"\n{quad}'))
    assert np.ptp(scene.still_meshes()["grey"].vertices_m) == pytest.approx(scale)


def test_a_fan_needs_an_axis(folder):
    fan = '[movers.m]\nkind = "fan"\nmaterial = "grey"\ncenter_m = [0, 3, 0]\nradius_m = 0.3\n'
    with pytest.raises(ConfigError, match=r"axis.*direction"):
        load_scene(folder(None, PLAIN + fan + "axis = [0, 0, 0]\n"))
