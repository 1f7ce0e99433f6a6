"""The additional parts of Nermo 4.1: vertical joints in the spine with their servo, and a head that tilts.

Both robots come from the same MJCF files; here the parts that only 4.1 has are added to the trees of `spine.xml` and
`head.xml`. Each vertical row of Table 5.3, a fixed frame in Nermo-Lite, gets a body with a hinge, which makes eight
joints with alternating axes.

The thesis gives the chain, the mass, the length and the number of servos of Nermo 4.1, but not how its tendons run.
Servo, guide and tilt axis are those of the author's later model (github.com/a-rohr/mouse_controller, commit 22caf00,
`models/dynamic_4l_t3.xml`). Its tendons run 7.5 mm above and 3 mm below the joints from one pulley: pulling in the
lower one needs 2.5 times as much of the upper one as the pulley releases, so in simulation its spine flexes by 0.06 rad
per joint and then stalls. Here both run at the same distance from the axes as the lateral tendons,
`SpineGeometry.segment_offset`, and (5.26) holds for both servos. Each tendon crosses the joints of the other plane on
their axes, so that neither servo bends the other plane.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from typing import Final

import mujoco
import numpy as np

from nermo_mjx.robot.parameters import SPINE

#: Pulley of the vertical spine's servo, from the spine base: centre [m] and pitch [rad].
PULLEY: Final = (0.0, -0.0355, 0.0055)
PULLEY_PITCH: Final = np.radians(6.0)
#: Where both tendons are tied, at its front and just outside the rim, and how far beside its centre they pass it [m].
TIE: Final = 0.0065125
SIDE: Final = 0.010
#: Where both tendons leave the torso, from the spine base [m].
GUIDE: Final = (0.0, -0.0200, 0.0070)
#: Axis of the head's tilt from the foot of the neck's axis [m].
TILT_AXIS: Final = (0.0, -0.0106, 0.0144)
#: How much further forward the head sits than Nermo-Lite's [m]. Its nose is then 53 mm in front of the tilt axis, as in
#: the author's model, and 405 mm in front of the tip of the tail, as published.
HEAD_FORWARD: Final = 0.0160

_COUNT: Final = len(SPINE.vertical_joints)
#: The side of a joint on which the sites of the upper and lower tendon lie; a vertical joint's z is left.
_SIGNS: Final = {"above": 1.0, "below": -1.0, "left": 1.0, "right": -1.0}


def _add_vertical_spine(root: ET.Element) -> None:
    """Give `spine.xml` vertical joints, with the pulley and the two tendons that bend them."""
    world, asset, tendon = (_found(root, name) for name in ("worldbody", "asset", "tendon"))
    for parent in list(root.iter()):
        for geom in parent.findall("geom[@mesh]"):
            if geom.get("mesh", "").startswith(("vertebra", "front")):
                parent.remove(geom)
        if parent.get("name", "").startswith("vertebra") and parent.tag == "body":
            parent.append(_geom("segment"))
    for number, row in enumerate(SPINE.vertical_joints, 1):
        _add_joint(root, _found(root, f".//frame[@name='row_{row}']"), number)
    _add_pulley(world)
    ET.SubElement(asset, "mesh", name="segment", file="spine_segment.obj")
    ET.SubElement(asset, "mesh", name="servo", file="servo.obj")
    for side in ("left", "right"):
        _lead(_found(tendon, f"spatial[@name='{side}']"), side)
    tendon.extend([_vertical_tendon("above", "right"), _vertical_tendon("below", "left")])


def _add_joint(root: ET.Element, frame: ET.Element, number: int) -> None:
    """The vertical joint `number` (from 1), in the frame of its row: x back, y up, z left, so that a positive angle
    lifts the hip.

    In the neutral spine the tendons run straight across it, though the spine bends there.
    """
    link = ET.Element("body", name=f"link_{number}")
    link.append(ET.Element("joint", {"name": f"vertical_{number}", "class": "spine", "axis": "0 0 1"}))
    link.extend([_geom("segment"), _geom("flexure", "rubber", euler="90 0 0")])
    link.extend(_site(f"{name}_{2 * number - 1}") for name in ("above", "below"))
    for child in list(frame):
        frame.remove(child)
        link.append(child)
    frame.extend(_site(f"{name}_{2 * number - 2}") for name in ("above", "below"))
    if number > 1:
        frame.extend(_site(f"{name}_axis_{number}") for name in ("left", "right"))
    frame.append(link)
    if number < _COUNT:
        lateral = _found(root, f".//site[@name='left_{2 * number - 2}']/..")
        lateral.extend(_site(f"{name}_axis_{number}") for name in ("above", "below"))


def _add_pulley(world: ET.Element) -> None:
    world.extend(_site(name) for name in ("vertical_left_side", "vertical_right_side", "vertical_guide"))
    servo = ET.SubElement(world, "frame", name="vertical_servo")
    servo.append(_geom("servo", "case", pos="0 0 -0.002", euler="0 -90 0"))
    pulley = ET.SubElement(world, "body", name="vertical_pulley")
    ET.SubElement(pulley, "joint", name="vertical_pulley", type="hinge", axis="0 0 1")
    ET.SubElement(pulley, "geom", {"name": "vertical_pulley", "class": "pulley", "size": "0.001 0.001"})
    pulley.extend([_geom("pulley", "metal"), _geom("pulley_holes", "case"), _site("vertical_rim")])


def _lead(tendon: ET.Element, side: str) -> None:
    """Lead a lateral tendon over the axes of the vertical joints between its segments."""
    for number in range(_COUNT, 1, -1):
        behind = _found(tendon, f"site[@site='{side}_{2 * number - 2}']")
        tendon.insert(list(tendon).index(behind), ET.Element("site", site=f"{side}_axis_{number}"))


def _vertical_tendon(name: str, side: str) -> ET.Element:
    """From the front of the pulley around one side of it, over the guide, and through all vertical joints."""
    tendon = ET.Element("spatial", name=name, limited="true", range="0 1", width="0.0005", material="tendon")
    ET.SubElement(tendon, "site", site="vertical_rim")
    ET.SubElement(tendon, "geom", geom="vertical_pulley", sidesite=f"vertical_{side}_side")
    for site in ("vertical_guide", *_passed(name)):
        ET.SubElement(tendon, "site", site=site)
    return tendon


def _passed(name: str) -> Iterator[str]:
    """The sites of a vertical tendon: before and behind each vertical joint, and the axis of the lateral one."""
    for number in range(1, _COUNT + 1):
        yield from (f"{name}_{2 * number - 2}", f"{name}_{2 * number - 1}")
        if number < _COUNT:
            yield f"{name}_axis_{number}"


def place_vertical_spine(spec: mujoco.MjSpec, ratio: float) -> None:
    """Position the parts that were added to `spine.xml`.

    Args:
        spec: of the spine.
        ratio: of the pulley's radius to the published one.
    """
    half, beside = SPINE.segment_length / 2, SPINE.segment_offset
    for name, sign in _SIGNS.items():
        for i, number in itertools.product((0, 1), range(1, _COUNT + 1)):
            if name in ("above", "below"):
                spec.site(f"{name}_{2 * number - 2 + i}").pos = np.array([(-half, half)[i], sign * beside, 0.0])
        for number in range(1, _COUNT + 1):
            axis = spec.site(f"{name}_axis_{number}")
            if axis is not None:
                axis.pos = np.array([0.0, 0.0, sign * beside])
    for element in (spec.body("vertical_pulley"), spec.frame("vertical_servo")):
        element.pos = np.array(PULLEY)
    spec.body("vertical_pulley").quat = np.array([np.cos(PULLEY_PITCH / 2), np.sin(PULLEY_PITCH / 2), 0.0, 0.0])
    for side in ("left", "right"):
        spec.site(f"vertical_{side}_side").pos = np.add(PULLEY, (_SIGNS[side] * SIDE, 0.0, 0.0))
    spec.site("vertical_guide").pos = np.array(GUIDE)
    spec.site("vertical_rim").pos = np.array([0.0, -TIE * ratio, 0.0])


def _add_head_tilt(root: ET.Element) -> None:
    """Put the head of `head.xml` on a bracket that pans, with the axis about which it tilts; positive is nose down."""
    world = _found(root, "worldbody")
    head = _found(world, "body[@name='head']")
    pan, *shell = list(head)
    for element in (pan, *shell):
        head.remove(element)
    world.remove(head)
    neck = ET.SubElement(world, "body", name="neck")
    neck.extend([pan, _geom("bracket"), head])
    ET.SubElement(head, "joint", name="head_tilt", type="hinge", axis="1 0 0")
    ET.SubElement(head, "frame", name="shell").extend(shell)
    ET.SubElement(_found(root, "asset"), "mesh", name="bracket", file="head_bracket.obj")


def place_head_tilt(spec: mujoco.MjSpec) -> None:
    """Put the head on its tilt axis."""
    spec.body("head").pos = np.array(TILT_AXIS)
    spec.frame("shell").pos = np.array([0.0, -HEAD_FORWARD, 0.0]) - TILT_AXIS


#: The edits that turn a part of Nermo-Lite into that of Nermo 4.1, by the name of its file.
EDITS: Final[dict[str, Callable[[ET.Element], None]]] = {"spine": _add_vertical_spine, "head": _add_head_tilt}


def _found(element: ET.Element, path: str) -> ET.Element:
    found = element.find(path)
    assert found is not None, path
    return found


def _site(name: str) -> ET.Element:
    return ET.Element("site", {"name": name, "class": "marker"})


def _geom(mesh: str, material: str = "", **place: str) -> ET.Element:
    given = {"material": material} if material else {}
    return ET.Element("geom", {"class": "visual", "mesh": mesh, **given, **place})
