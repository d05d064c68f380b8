"""URDF: links with inertials and primitive collision shapes, and joints."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from diffrigid.contact import Contact
from diffrigid.convert import known_number
from diffrigid.models.frames import Frame, from_euler
from diffrigid.models.geoms import ALONG_Z
from diffrigid.models.links import Geometry, Joint, Link, Mass, assemble, free_name, turned
from diffrigid.models.xml import Reader, read_xml
from diffrigid.shapes import Box, Capsule, Sphere
from diffrigid.state import State
from diffrigid.world import World

KINDS = {"revolute": "hinge", "continuous": "hinge", "prismatic": "slide", "fixed": "weld", "floating": "free"}
QUIET = ("material", "transmission", "gazebo")


@np.errstate(over="ignore", invalid="ignore")  # `scene` then refuses numbers that are not finite
def load_urdf(
    path: str | Path, *, gravity: Any = (0.0, 0.0, -9.81), friction: Any = 0.0, restitution: Any = 0.0,
    contact: Contact | None = None, floating: bool = False,
) -> tuple[World, State]:  # fmt: skip
    """Load a URDF file: the world, and its initial state with all joints at zero.

    Every link with an inertial becomes a `Body` of its name, with its origin at the centre of mass and the axes of its
    collision shape. A link without an inertial that is fixed to another one is a frame of that one.

    Args:
        gravity: (3,) [m/s^2]. friction, restitution: [-] of all links. contact: as in `scene`.
        floating: the root moves freely; else it is fixed to the world.

    Raises:
        ValueError: names the element and the attribute that cannot be read, links in a loop or without a mass.

    Warns:
        UserWarning: names all that is left out: meshes and cylinders do not collide.

    Example:
        >>> text = '''<robot name="r"><link name="rod"><inertial><mass value="2"/><origin xyz="0 0 -0.5"/>
        ... <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'''
        >>> _ = Path("rod.urdf").write_text(text)
        >>> made, start = dr.load_urdf("rod.urdf", floating=True)
        >>> made.names, start.x.tolist()  # x is the centre of mass
        (('rod',), [[0.0, 0.0, -0.5]])
    """
    where, root = str(path), read_xml(path, "robot")
    left_out: list[str] = [f"{e.tag}" for e in root if e.tag not in ("link", "joint", *QUIET)]
    elements = {_name(where, link): link for link in root.findall("link")}
    if len(elements) != len(root.findall("link")):
        raise ValueError(f"{where} has two links of one name")
    joints: dict[str, ElementTree.Element] = {}  # by the link that they move
    for joint in root.findall("joint"):
        parent, child = (_end(where, joint, end, elements) for end in ("parent", "child"))
        if child in joints:
            raise ValueError(f"{where}: link {child!r} is the child of two joints: expected a tree")
        joints[child] = joint
    links: list[Link] = []
    places: dict[str, tuple[Link, Frame]] = {}  # of each link: the one that it is part of, and where in it
    called: dict[str, str] = {}  # in the scene
    for name in elements:
        called[name] = free_name(name, called.values(), "_")
    taken, rub = set(called.values()), float(known_number("friction", friction))
    for name in _ordered(where, elements, joints):
        element, moved_by = elements[name], joints.get(name)
        mass, geometry = _mass(where, name, element), _geometry(where, name, element, rub, left_out, taken)
        link, place = _link(where, name, moved_by, places, mass, geometry, left_out, floating, called[name])
        places[name] = link, place
        if place is _WHOLE:
            links.append(link)
        else:
            left_out += [f"{g.name} of {name}, which has no inertial" for g in geometry if not link.still]
    return assemble(where, links, left_out, [], gravity, restitution, contact)


_WHOLE = Frame()


def _link(where, name, element, places, mass, geometry, left_out, floating, called):
    """Make a link, or take the one that it is fixed to; return it with the pose in it."""
    if element is None:
        moves = floating and mass is not None
        return Link(called, Frame(), None, Joint("free" if moves else "weld"), mass, geometry, not moves), _WHOLE
    owner, inside = places[_end(where, element, "parent", places)]
    origin = inside @ _origin(where, f"joint of {name}", element)
    joint = _joint(where, element, left_out)
    if joint.kind == "weld" and mass is None and not (owner.still and geometry):
        return owner, origin
    still = joint.kind == "weld" and owner.still
    return Link(called, owner.frame @ origin, owner.name, joint, mass, geometry, still), _WHOLE


def _ordered(where: str, elements: dict, joints: dict) -> list[str]:
    """Names of the links, parents first, from the one root."""
    roots = [name for name in elements if name not in joints]
    if len(roots) != 1:
        raise ValueError(f"{where} has the roots {roots}: expected exactly one link that is not the child of a joint")
    out = [roots[0]]
    for name in out:
        out += [child for child, joint in joints.items() if _end(where, joint, "parent", elements) == name]
    if lost := [name for name in elements if name not in out]:
        raise ValueError(f"{where}: links {lost} form a loop: expected a tree")
    return out


def _name(where: str, element: ElementTree.Element) -> str:
    if not element.get("name"):
        raise ValueError(f"{where}: a <{element.tag}> has no name")
    return element.attrib["name"]


def _end(where: str, joint: ElementTree.Element, end: str, links: Any) -> str:
    found = joint.find(end)
    name = None if found is None else found.get("link")
    if name not in links:
        raise ValueError(f"{where}: joint {joint.get('name')!r} has the {end} {name!r}: expected a link of the file")
    return str(name)


def _reader(where: str, label: str, parent: ElementTree.Element, tag: str) -> Reader:
    """Reader of the attributes of a child element; it has none where there is no such child."""
    found = parent.find(tag)
    return Reader(where, f"{tag} of {label}", {} if found is None else dict(found.attrib))


def _origin(where: str, label: str, element: ElementTree.Element) -> Frame:
    """Pose by <origin xyz rpy>: roll, pitch and yaw about the fixed axes x, y, z."""
    reader = _reader(where, label, element, "origin")
    return Frame(reader.numbers("xyz", 3, np.zeros(3)), from_euler(reader.numbers("rpy", 3, np.zeros(3)), "XYZ"))


def _mass(where: str, name: str, element: ElementTree.Element) -> Mass | None:
    inertial = element.find("inertial")
    if inertial is None:
        return None
    frame = _origin(where, f"inertial of {name}", inertial)
    mass = _reader(where, f"inertial of {name}", inertial, "mass").number("value")
    if mass == 0:
        return None
    given = _reader(where, f"inertial of {name}", inertial, "inertia")
    xx, yy, zz = (given.number(key) for key in ("ixx", "iyy", "izz"))
    xy, xz, yz = (given.number(key, 0.0) for key in ("ixy", "ixz", "iyz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Mass(mass, frame.x, turned(inertia, frame.R))


def _geometry(where: str, name: str, element: ElementTree.Element, friction: float, left_out: list, taken: set[str]):
    """The collision shapes of a link, under names that are not taken."""
    out = []
    for index, collision in enumerate(element.findall("collision")):
        frame, holder = _origin(where, f"collision of {name}", collision), collision.find("geometry")
        solid = None if holder is None or not len(holder) else holder[0]
        if solid is None:
            raise ValueError(f"{where}: a <collision> of {name!r} has no geometry")
        reader = Reader(where, f"{solid.tag} of {name}", dict(solid.attrib))
        shape: Any = None
        match solid.tag:
            case "sphere":
                shape = Sphere(radius=reader.number("radius"))
            case "box":
                shape = Box(half=0.5 * reader.numbers("size", 3))
            case "capsule":
                half, frame = 0.5 * reader.number("length"), Frame(frame.x, frame.R @ ALONG_Z)
                shape = Capsule(radius=reader.number("radius"), half_length=half)
            case _:
                left_out.append(f"contacts of {name}, a {solid.tag}")
                continue
        label = free_name(collision.get("name") or f"{name}_collision{index}", taken, "_")
        taken.add(label)
        out.append(Geometry(label, shape, frame, friction))
    return tuple(out)


def _joint(where: str, element: ElementTree.Element, left_out: list[str]) -> Joint:
    name, kind = _name(where, element), element.get("type", "")
    if kind not in KINDS:
        raise ValueError(f"{where}: joint {name!r} has the type {kind!r}: expected one of {', '.join(KINDS)}")
    known = ("origin", "parent", "child", "axis", "limit", "dynamics")
    left_out += [f"{child.tag} of joint {name!r}" for child in element if child.tag not in known]
    axis = _reader(where, name, element, "axis").numbers("xyz", 3, (1.0, 0.0, 0.0))
    if not axis.any():
        raise ValueError(f"{where}: the axis of joint {name!r} is zero: expected a direction")
    limit, dynamics = (_reader(where, name, element, tag) for tag in ("limit", "dynamics"))
    lower = upper = None
    if kind in ("revolute", "prismatic"):
        lower, upper = limit.number("lower", 0.0), limit.number("upper", 0.0)
    left_out += limit.left_out("lower", "upper", "effort", "velocity")
    if lower == upper == 0:
        left_out.append(f"motion of joint {name!r}, whose limits are equal")
        return Joint("weld", name)
    return Joint(
        KINDS[kind], name, axis=axis, lower=lower, upper=upper,
        damping=dynamics.number("damping", 0.0), friction=dynamics.number("friction", 0.0),
    )  # fmt: skip
