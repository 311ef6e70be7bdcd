"""Still shapes in Mitsuba's XML beside ``scene.toml``, checked without Mitsuba.

Only shapes and surfaces are allowed in the file.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from pydantic import Field, field_validator

from optsim.core.config import Part
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.files import content_hash
from optsim.scene.mesh_files import check_mesh

_MATT = ("diffuse", "twosided", "mask", "bumpmap", "normalmap", "blendbsdf")
_TOP_LEVEL = ("shape", "bsdf", "texture", "default")
# Element -> the right place for its content; other elements inside a shape are left to Mitsuba.
_BANNED = {
    "emitter": "lamps belong in [lamps] of scene.toml",
    "sensor": "the camera belongs in [camera] of scene.toml",
    "film": "the camera belongs in [camera] of scene.toml",
    "sampler": "the renderer chooses its own",
    "integrator": "the renderer chooses its own; max_depth belongs in scene.toml",
    "medium": "participating media are not rendered",
    "phase": "participating media are not rendered",
    "volume": "participating media are not rendered",
    "include": "a scene is one file; paste its content here",
    "path": "name files relative to the scene's folder",
    "alias": "use the shape's or surface's own id",
}


class StaticShapes(Part):
    """Text of a shapes file, with at least one shape and neither sensor nor emitter.

    Parameters
    ----------
    name : str
        File name, for messages.
    text : str
        The XML.
    files : dict
        Files it refers to, by their name relative to the folder -> hash of their content.
    folder : str
        Folder of these files; it does not affect a render's identity.
    """

    name: str
    text: str
    files: dict[str, str] = Field(default={})
    folder: str = Field("", exclude=True)

    @field_validator("text")
    @classmethod
    def _only_shapes(cls, text: str) -> str:
        _check(_parsed(text))
        return text

    def polarises(self) -> bool:
        """Whether a surface in it may polarise light: any that is neither matt nor a wrapper of matt ones."""
        return any(surface.get("type") not in _MATT for surface in _parsed(self.text).iter("bsdf"))

    def ready(self, unit_m: float = 1.0) -> str:
        """XML with absolute paths, in lengths of ``unit_m``.

        Parameters
        ----------
        unit_m : float
            Length of the renderer's unit, m.
        """
        root = _parsed(self.text)
        for element, key in _file_places(root):
            element.set(key, str(Path(self.folder) / element.get(key, "")))
        if unit_m != 1.0:
            for shape in root.findall("shape"):
                if shape.get("type") != "shapegroup":  # only its instances are in the scene
                    place = shape.find("transform[@name='to_world']")
                    if place is None:
                        place = ElementTree.SubElement(shape, "transform", name="to_world")
                    ElementTree.SubElement(place, "scale", value=repr(1 / unit_m))
        return ElementTree.tostring(root, encoding="unicode")


def read_static(folder: Path, name: str) -> StaticShapes:
    """Read and check the shapes file of a scene, and hash the files that it refers to."""
    path = folder / name
    if Path(name).name != name or not path.is_file():
        raise ConfigError(
            f"static: got {name!r}, expected the name of an XML file beside {folder / 'scene.toml'}; "
            "cure: put it there, or remove the key"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
        root = _parsed(text)
        _check(root)
        kinds = _mesh_kinds(root)
        files = {
            key: _hash_of_file(folder, key, kinds.get(key, set()))
            for key in sorted({e.get(k, "") for e, k in _file_places(root)})
        }
    except (ValueError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: {error}") from None
    return StaticShapes(name=name, text=text, files=files, folder=str(folder.resolve()))


def _parsed(text: str) -> ElementTree.Element:
    # Entities may refer to other files or expand without limit; shapes need none.
    if re.search(r"<!(DOCTYPE|ENTITY)", text):
        raise ValueError("a document type or entity is not allowed; cure: remove it")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None


def _check(root: ElementTree.Element) -> None:
    if root.tag != "scene" or "version" not in root.attrib:
        raise ValueError(f'got <{root.tag}>, expected <scene version="3.0.0"> around everything')
    for element in root.iter():
        if element.tag in _BANNED:
            raise ValueError(f"<{element.tag}> is not allowed; {_BANNED[element.tag]}")
    for child in root:
        if child.tag not in _TOP_LEVEL:
            raise ValueError(
                f"{unknown_name('element', f'<{child.tag}>', [f'<{tag}>' for tag in _TOP_LEVEL])}"
            )
    if not [shape for shape in root.findall("shape") if shape.get("type") != "shapegroup"]:
        raise ValueError("no shape in it; cure: add one, or remove the key static from scene.toml")
    ids = [
        element.get("id", "") for element in root.iter() if element.tag != "ref" and "id" in element.attrib
    ]
    if twice := sorted({key for key in ids if ids.count(key) > 1}):
        raise ValueError(f"id {twice[0]!r} is used twice; cure: rename one")
    for reference in root.iter("ref"):
        if reference.get("id", "") not in ids:
            raise unknown_reference(reference.get("id", ""), ids)


def unknown_reference(got: str, ids: list[str]) -> ValueError:
    """Error for a reference to an id that no element has."""
    return ValueError(str(unknown_name("id in a <ref>", got, ids or ["(none declared)"])))


def _file_places(root: ElementTree.Element) -> list[tuple[ElementTree.Element, str]]:
    """Elements that name a file, and the attribute that does."""
    places = [(element, "filename") for element in root.iter() if "filename" in element.attrib]
    return places + [(e, "value") for e in root.iter("string") if e.get("name") == "filename"]


def _mesh_kinds(root: ElementTree.Element) -> dict[str, set[str]]:
    """Types of the shapes that name each file."""
    kinds: dict[str, set[str]] = {}
    for shape in root.iter("shape"):
        for element in shape.findall("string[@name='filename']"):
            kinds.setdefault(element.get("value", ""), set()).add(shape.get("type", ""))
    return kinds


def _hash_of_file(folder: Path, name: str, kinds: set[str]) -> str:
    path = (folder / name).resolve()
    if "$" in name or not path.is_relative_to(folder.resolve()):
        raise ValueError(
            f"file {name!r}: expected a plain name inside the scene's folder; cure: copy the file there"
        )
    if not path.is_file():
        raise ValueError(f"file {name!r} is not in the scene's folder {folder}; cure: put it there")
    for kind in sorted(kinds) or [""]:
        check_mesh(path, kind)
    return content_hash(path)
