"""MJCF, the files of MuJoCo: bodies, primitive geoms, inertials, joints and default classes."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from diffrigid.contact import Contact
from diffrigid.convert import largest
from diffrigid.models.frames import Frame, about, from_axes, from_euler, from_quaternion, onto
from diffrigid.models.geoms import geometry_of, mass_of
from diffrigid.models.links import Geometry, Joint, Link, Mass, assemble, free_name, total
from diffrigid.models.xml import Reader, read_xml
from diffrigid.state import State
from diffrigid.world import World

LOOKS = ("rgba", "material", "group")  # attributes that change no motion
QUIET = ("asset", "visual", "statistic", "size", "custom", "sensor", "worldbody", "default", "compiler", "option")
SEEN = ("light", "camera", "site")  # elements of bodies that change no motion
BREAKING = ("frame", "replicate", "composite", "flexcomp", "attach", "plugin")  # without which the rest is wrong
KINDS = ("hinge", "slide", "ball", "free")


@dataclass
class Model:
    """Settings of the whole file, and what has been read from it so far."""

    where: str
    degrees: bool
    sequence: str
    limited: bool  # a range is a limit
    from_geoms: str  # "auto", "true" or "false": masses
    classes: dict[str, dict[str, dict[str, str]]]
    links: list[Link] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    names: set[str] = field(default_factory=set)

    def reader(self, element: ElementTree.Element, scope: str) -> Reader:
        """Reader of the attributes of an element and of its class."""
        name = element.get("class", scope)
        if name not in self.classes:
            raise ValueError(f"{self.where}: <{element.tag}> has the class {name!r}, which is not in <default>")
        return Reader(self.where, element.tag, {**self.classes[name].get(element.tag, {}), **element.attrib})

    def name_of(self, element: ElementTree.Element, default: str) -> str:
        """Name of a body or geom, changed if it is taken."""
        name = free_name(element.get("name", default), self.names, "_")
        self.names.add(name)
        return name


@np.errstate(over="ignore", invalid="ignore")  # `scene` then refuses numbers that are not finite
def load_mjcf(path: str | Path, *, restitution: Any = 0.0, contact: Contact | None = None) -> tuple[World, State]:
    """Load a MuJoCo file: the world, and its initial state.

    Every body becomes a `Body` of its name, with its origin at the centre of mass and the axes of its geom; geoms of
    the world become statics. Bodies without a joint are welded to their parent. A contact takes the mean of the two
    sliding frictions, where MuJoCo takes the larger one.

    Args:
        restitution: [-] of all bodies; MuJoCo has none. contact: as in `scene`.

    Raises:
        ValueError: names the element and the attribute that cannot be read.

    Warns:
        UserWarning: names all that is left out: meshes, cylinders and ellipsoids do not collide, the geoms of a body
            have one friction; actuators, tendons, springs of joints, armature.

    Example:
        >>> text = '''<mujoco><worldbody><geom name="ground" type="plane" size="1 1 1" friction="0.6"/><body name="ball"
        ... pos="0 0 1"><freejoint/><geom type="sphere" size="0.1" mass="1"/></body></worldbody></mujoco>'''
        >>> _ = Path("ball.xml").write_text(text)
        >>> made, start = dr.load_mjcf("ball.xml", restitution=0.7)
        >>> made.names, made.static_names, made.statics.friction.tolist(), made.bodies.friction.tolist()
        (('ball',), ('ground',), [0.6], [1.0])
    """
    where, root = str(path), read_xml(path, "mujoco")
    _include(root, Path(path).parent, (Path(path).resolve(),))
    compiler = _merged(where, root, "compiler")
    angle, mode = compiler.word("angle", "degree", "radian"), compiler.word("inertiafromgeom", "auto", "true", "false")
    if compiler.text("coordinate", "local") != "local":
        raise ValueError(f"{where}: <compiler coordinate='global'> cannot be loaded: expected local coordinates")
    sequence = str(compiler.text("eulerseq", "xyz"))
    if len(sequence) != 3 or not set(sequence.lower()) <= set("xyz"):
        raise ValueError(f"{compiler.where}: eulerseq is {sequence!r}: expected three letters of x, y, z, X, Y, Z")
    limited = compiler.word("autolimits", "true", "false") == "true"
    model = Model(where, angle == "degree", sequence, limited, mode, _classes(where, root))
    option = _merged(where, root, "option")
    gravity = option.numbers("gravity", 3, (0.0, 0.0, -9.81))
    model.left_out += compiler.left_out("meshdir", "texturedir", "assetdir", "discardvisual", "strippath", "usethread")
    model.left_out += option.left_out()
    for world in root.findall("worldbody"):
        _children(model, world, Link("world", Frame(), None, Joint("weld"), None, still=True), "main")
    apart = []
    for element in root:
        if element.tag == "contact":
            apart += [(e.get("body1", ""), e.get("body2", "")) for e in element.findall("exclude")]
            model.left_out += [f"contact {e.tag}" for e in element if e.tag != "exclude"]
        elif element.tag not in QUIET and len(element):
            model.left_out.append(f"{element.tag} ({', '.join(sorted({e.tag for e in element}))})")
    return assemble(where, model.links, model.left_out, apart, gravity, restitution, contact)


def _include(root: ElementTree.Element, folder: Path, parents: tuple[Path, ...]) -> None:
    """Replace each <include> by the content of its file."""
    for parent in list(root.iter()):
        for place, element in reversed(list(enumerate(parent))):
            if element.tag == "include":
                if not element.get("file"):
                    raise ValueError(f"{parents[-1]}: an <include> has no file")
                path = (folder / element.get("file", "")).resolve()
                if path in parents:
                    raise ValueError(f"{path} includes itself")
                inner = read_xml(path, None)
                _include(inner, folder, (*parents, path))
                parent.remove(element)
                for child in reversed(inner):
                    parent.insert(place, child)


def _merged(where: str, root: ElementTree.Element, tag: str) -> Reader:
    """Merge all elements of a section; later ones win."""
    return Reader(where, tag, {k: v for element in root.findall(tag) for k, v in element.attrib.items()})


def _classes(where: str, root: ElementTree.Element) -> dict[str, dict[str, dict[str, str]]]:
    """Attributes by class and element; a class inherits those of the class around it."""
    classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}

    def walk(element: ElementTree.Element, outer: dict[str, dict[str, str]], default: str | None) -> None:
        name = element.get("class", default)
        if name is None:
            raise ValueError(f"{where}: a <default> in another has no class: expected a name")
        own = {tag: dict(attributes) for tag, attributes in classes.get(name, outer).items()}
        for child in element:
            if child.tag != "default":
                own[child.tag] = {**own.get(child.tag, {}), **child.attrib}
        classes[name] = own
        for child in element.findall("default"):
            walk(child, own, None)

    for element in root.findall("default"):
        walk(element, {}, "main")
        classes["main"] = classes[element.get("class", "main")]
    return classes


# ---- bodies


def _children(model: Model, element: ElementTree.Element, parent: Link, scope: str) -> None:
    """Read the bodies in an element, and the geoms if it is the world."""
    scope = element.get("childclass", scope)
    if odd := [child.tag for child in element if child.tag in BREAKING]:
        raise ValueError(f"{model.where}: <{odd[0]}> in {parent.name!r} cannot be loaded: write it out as bodies")
    if parent.name == "world":
        geometry = tuple(_geoms(model, element, "world", scope)[0])
        model.links.append(Link("world", Frame(), None, Joint("weld"), None, geometry, still=True))
    for child in element.findall("body"):
        _body(model, child, parent, scope)


def _body(model: Model, element: ElementTree.Element, parent: Link, scope: str) -> None:
    inner = element.get("childclass", scope)
    name = model.name_of(element, f"body{len(model.links)}")
    reader = Reader(model.where, "body", dict(element.attrib))
    frame = parent.frame @ Frame(reader.numbers("pos", 3, np.zeros(3)), _rotation(model, reader))
    joint = _joint(model, element, name, parent, inner)
    geometry, masses = _geoms(model, element, name, inner)
    still = joint.kind == "weld" and parent.still
    link = Link(name, frame, parent.name, joint, _mass(model, element, name, masses), tuple(geometry), still)
    model.links.append(link)
    model.left_out += reader.left_out("childclass", "user")
    known = (*SEEN, "geom", "joint", "freejoint", "inertial", "body", *BREAKING)
    model.left_out += [f"{child.tag} of body {name!r}" for child in element if child.tag not in known]
    _children(model, element, link, scope)


def _rotation(model: Model, reader: Reader) -> np.ndarray:
    """Rotation R of quat, axisangle, euler, xyaxes or zaxis."""
    scale = np.pi / 180.0 if model.degrees else 1.0
    given = [name for name in ("quat", "axisangle", "euler", "xyaxes", "zaxis") if reader.given(name)]
    if len(given) > 1:
        raise ValueError(f"{reader.where} has {given[0]} and {given[1]}: expected one orientation")
    match given:
        case ["quat"]:
            return from_quaternion(_direction(reader, "quat", 4))
        case ["axisangle"]:
            *axis, angle = reader.numbers("axisangle", 4)
            return about(_not_zero(reader, "axisangle", np.array(axis)), scale * angle)
        case ["euler"]:
            return from_euler(scale * reader.numbers("euler", 3), model.sequence)
        case ["xyaxes"]:
            x, y = _not_zero(reader, "xyaxes", reader.numbers("xyaxes", 6).reshape(2, 3).T).T
            if not np.cross(x / np.linalg.norm(x), y / np.linalg.norm(y)).any():
                raise ValueError(f"{reader.where}: xyaxes is {reader.text('xyaxes')!r}: expected two directions")
            return from_axes(x, y)
        case ["zaxis"]:
            return onto(_direction(reader, "zaxis", 3))
    return np.eye(3)


def _direction(reader: Reader, name: str, count: int, default: Any = None) -> np.ndarray:
    return _not_zero(reader, name, reader.numbers(name, count, default))


def _not_zero(reader: Reader, name: str, values: np.ndarray) -> np.ndarray:
    """Return a direction, or several as columns, after a check that none is zero."""
    if (np.abs(values).max(0) < 1 / largest(float)).any():
        raise ValueError(f"{reader.where}: {name} is zero: expected a direction")
    return values


def _mass(model: Model, element: ElementTree.Element, name: str, masses: list[Mass]) -> Mass | None:
    """Mass by <inertial>, or summed over the geoms."""
    inertial = element.find("inertial")
    if inertial is None or _weighs_geoms(model, element):
        return total(masses) if masses else None
    reader = Reader(model.where, f"inertial of {name}", dict(inertial.attrib))
    R = _rotation(model, reader)
    if reader.given("fullinertia"):
        xx, yy, zz, xy, xz, yz = reader.numbers("fullinertia", 6)
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        inertia = R @ np.diag(reader.numbers("diaginertia", 3)) @ R.T
    return Mass(reader.number("mass"), reader.numbers("pos", 3), inertia)


def _weighs_geoms(model: Model, element: ElementTree.Element) -> bool:
    """Whether the mass of a body is that of its geoms: the world has none."""
    by_geoms = {"true": True, "false": False, "auto": element.find("inertial") is None}
    return element.tag == "body" and by_geoms[model.from_geoms]


def _geoms(model: Model, element: ElementTree.Element, body: str, scope: str) -> tuple[list[Geometry], list[Mass]]:
    """Shapes and masses of the geoms of a body."""
    shapes, masses, weighed = [], [], _weighs_geoms(model, element)
    for index, geom in enumerate(element.findall("geom")):
        reader = model.reader(geom, scope)
        name = model.name_of(geom, f"{body}_geom{index}")
        bits = int(reader.number("contype", 1)), int(reader.number("conaffinity", 1))
        made = geometry_of(reader, _rotation(model, reader))
        rub = reader.some("friction")[0] if reader.given("friction") else 1.0
        shapes.append(Geometry(name, made.shape, made.frame, float(rub), bits))
        if made.shape is None and any(bits):
            model.left_out.append(f"contacts of {reader.label or name}, a {made.kind}")
        if weighed and (mass := mass_of(reader, made)) is not None:
            masses.append(mass)
        model.left_out += reader.left_out(*LOOKS, "density", "mass")
    return shapes, masses


def _joint(model: Model, element: ElementTree.Element, name: str, parent: Link, scope: str) -> Joint:
    """The one joint of a body."""
    found = [child for child in element if child.tag in ("joint", "freejoint")]
    if not found:
        return Joint("weld")
    if len(found) > 1:
        raise ValueError(
            f"{model.where}: body {name!r} has {len(found)} joints: expected one; put a body with a small mass between "
            "each two, or a ball for three hinges in one point"
        )
    if found[0].tag == "freejoint":
        kind, reader = "free", Reader(model.where, "freejoint", dict(found[0].attrib))
    else:
        reader = model.reader(found[0], scope)
        kind = str(reader.text("type", "hinge"))
    if kind not in KINDS:
        raise ValueError(f"{reader.where}: type is {kind!r}: expected one of {', '.join(KINDS)}")
    if kind == "free" and parent.name != "world":
        raise ValueError(f"{reader.where} is free, but {name!r} is in {parent.name!r}: expected it in <worldbody>")
    joint = _driven(model, reader, kind) if kind in ("hinge", "slide") else Joint(
        kind, str(reader.text("name", "")), reader.numbers("pos", 3, np.zeros(3))
    )  # fmt: skip
    unimportant = [*LOOKS, "user", "limited", "actuatorfrclimited", "springref", "ref"]
    unimportant += ["axis"] if kind in ("ball", "free") else []
    model.left_out += [text for text in reader.left_out(*unimportant) if not _is_zero(reader, text)]
    return joint


def _driven(model: Model, reader: Reader, kind: str) -> Joint:
    """A hinge or a slider, its limits counted from its initial position."""
    scale = np.pi / 180.0 if model.degrees and kind == "hinge" else 1.0
    lower = upper = None
    limited = reader.word("limited", "auto", "true", "false")
    if limited == "true" or limited == "auto" and model.limited and reader.given("range"):
        ends = scale * (reader.numbers("range", 2) - reader.number("ref", 0.0))
        if limited == "true" or ends[0] < ends[1]:
            lower, upper = map(float, ends)
    reader.text("range")
    return Joint(
        kind, str(reader.text("name", "")), reader.numbers("pos", 3, np.zeros(3)),
        _direction(reader, "axis", 3, (0.0, 0.0, 1.0)), lower, upper,
        float(reader.some("damping")[0]) if reader.given("damping") else 0.0, reader.number("frictionloss", 0.0),
    )  # fmt: skip


def _is_zero(reader: Reader, text: str) -> bool:
    """Whether an attribute that is left out is 0, so that it changes nothing."""
    value = reader.attributes[text.split(" of ")[0]]
    return all(part.strip("+-0.") == "" for part in value.split())
