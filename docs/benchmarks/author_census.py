"""Lists every constant of the author's MuJoCo model next to the robot model `author`, in one frame.

    git clone https://github.com/a-rohr/mouse_controller author && git -C author checkout 736e7ec
    python docs/benchmarks/author_census.py author

It writes `author_census.csv` beside this file, and ends with an error if a difference above 0.3 mm, 1 degree or 5 % has
no reason in `REASONS`. Positions are in the torso's frame, from the point between the shoulders, with a straight spine.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd

from nermo_mjx.control.parameters import author_body
from nermo_mjx.physics.variation import compile_model
from nermo_mjx.robot import LIMBS, load_robot

SHORT = dict(zip(LIMBS, ("fl", "fr", "rl", "rr"), strict=True))
LIMITS = {"mm": 0.3, "deg": 1.0}
LIMIT_PERCENT = 5.0
#: Reasons of differences, by the beginning of the name of a value. The first that matches counts.
REASONS = {
    "spine joint": "Table 5.3 of the thesis, whose chain has other angles than the author's MJCF",
    "spine pulley": "it follows the spine end of Table 5.3",
    "whole, centre of mass, left": "the author did not mirror the box of the right front servo",
    "range of front_left_knee": "the wrap of a tendon stays below 175 degrees; no walk reaches the limit",
    "range of rear_left_knee": "the wrap of a tendon stays below 175 degrees; no walk reaches the limit",
}


def author_spec(folder: Path) -> mujoco.MjSpec:
    """The author's model with the contact override written into its geoms, without meshes that carry no mass."""

    def included(text: str) -> str:
        def part(match: re.Match[str]) -> str:
            inner = re.sub(r"<!--.*?-->", "", (folder / match[1]).read_text(), flags=re.DOTALL)
            return included(re.sub(r"^\s*<mujoco[^>]*>|</mujoco>\s*$", "", inner.strip()))

        return re.sub(r'<include\s+file="([^"]+)"\s*/>', part, text)

    text = (folder / "dynamic_4l_t3.xml").read_text()
    text = included(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
    for tag in re.findall(r"<mesh [^>]*/>", text):
        (file,), (name,) = (re.findall(rf'{key}="([^"]+)"', tag) for key in ("file", "name"))
        if not (folder / file).exists():
            text = re.sub(rf'<geom [^>]*mesh="{name}"[^>]*/>', "", text.replace(tag, ""))
    return mujoco.MjSpec.from_string(
        text.replace('<compiler angle="degree"/>', f'<compiler angle="degree" meshdir="{folder}"/>')
    )


class Side:
    """One of the two models, at its zero pose.

    Attributes:
        model, data: The model and its state.
        origin, frame: Point between the shoulders, and rotation of the torso.
    """

    def __init__(self, model: mujoco.MjModel, torso: str, shoulders: tuple[str, str]) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self.data)
        self.origin = np.mean([self.data.body(name).xpos for name in shoulders], axis=0)
        self.frame = self.data.body(torso).xmat.reshape(3, 3)

    def place(self, point: np.ndarray) -> np.ndarray:
        """A point of the world in the torso's frame [mm]."""
        return 1e3 * (point - self.origin) @ self.frame

    def whole(self, root: str) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass [kg], centre of mass [mm] and principal entries of the inertia [g cm^2] of a body and its children."""
        model, data, first = self.model, self.data, self.model.body(root).id
        bodies = [i for i in range(first, model.nbody) if model.body_rootid[i] == first]
        mass = model.body_mass[bodies]
        points = np.array([self.place(data.xipos[i]) for i in bodies])
        centre, inertia = mass @ points / mass.sum(), np.zeros((3, 3))
        for body, weight, point in zip(
            bodies, mass, points - mass @ points / mass.sum(), strict=True
        ):
            turn = self.frame.T @ data.ximat[body].reshape(3, 3)
            inertia += 1e7 * turn @ np.diag(model.body_inertia[body]) @ turn.T
            inertia += 10.0 * weight * (point @ point * np.eye(3) - np.outer(point, point))
        return float(mass.sum()), centre, np.diag(inertia)


def stand(author: Side, ours: Side) -> None:
    """Give both models the legs of our zero pose, each in the frame of its mount."""
    rest = {"front": np.radians(50.0), "rear": np.radians(-75.0)}
    for limb, short in SHORT.items():
        hip, knee = (ours.data.joint(f"{limb}_{name}").qpos[0] for name in ("hip", "knee"))
        axis = ours.model.joint(f"{limb}_hip").axis[0], ours.model.joint(f"{limb}_knee").axis[0]
        author.data.joint(f"m1_{short}").qpos = hip * axis[0]
        author.data.joint(f"knee1_{short}").qpos = knee * axis[1] + rest[limb.split("_")[0]]
        author.data.joint(f"ankle_{short}").qpos = 0.0
    mujoco.mj_forward(author.model, author.data)


def census(author: Side, ours: Side) -> list[tuple[str, str, float, float]]:
    """Name, unit, the author's value and ours."""
    rows: list[tuple[str, str, float, float]] = []

    def add(name: str, unit: str, first: Any, second: Any) -> None:
        rows.append((name, unit, float(first), float(second)))

    def add_place(name: str, first: np.ndarray, second: np.ndarray) -> None:
        places = zip(("left", "back", "up"), author.place(first), ours.place(second), strict=True)
        for axis, one, two in places:
            add(f"{name}, {axis}", "mm", one, two)

    def add_joint(name: str, first: str, second: str) -> None:
        one, two = author.model.joint(first), ours.model.joint(second)
        add(f"{name} stiffness", "N m/rad", one.stiffness[0], two.stiffness[0])
        add(f"{name} damping", "N m s/rad", one.damping[0], two.damping[0])
        add(f"{name} armature", "kg m^2", one.armature[0], two.armature[0])

    first, second = author.model, ours.model
    stand(author, ours)
    for limb, short in SHORT.items():
        add_place(
            f"{limb} axis",
            author.data.body(f"main_leg_{short}").xpos,
            ours.data.body(f"{limb}_upper").xpos,
        )
        add_place(
            f"{limb} pulley",
            author.data.body(f"servo2_{short}").xpos,
            ours.data.body(f"{limb}_pulley").xpos,
        )
        if limb.endswith("right"):
            continue
        pair = limb.split("_")[0]
        for link, one, two in (
            ("upper leg", first.body(f"lower_leg_{short}").pos, second.body(f"{limb}_lower").pos),
            ("lower leg", first.body(f"foot_{short}").pos, second.body(f"{limb}_foot").pos),
            ("foot", first.site(f"foot_s_{short}").pos, second.site(f"{limb}_foot").pos),
            (
                "attachment",
                first.site(f"m2_pickup_{short}").pos,
                second.site(f"{limb}_attachment").pos,
            ),
        ):
            add(
                f"{pair} {link}, length", "mm", 1e3 * np.linalg.norm(one), 1e3 * np.linalg.norm(two)
            )
        sole, our_sole = first.geom(f"foot_placement_{short}2"), second.geom(f"{limb}_sole")
        add(f"{pair} sole, radius", "mm", 1e3 * sole.size[0], 1e3 * our_sole.size[0])
        add(f"{pair} sole, width", "mm", 2e3 * sole.size[1], 2e3 * our_sole.size[1])
        radius = (first.geom(f"motor2_{short}").size[0], second.geom(f"{limb}_pulley").size[0])
        add(f"{pair} pulley, radius", "mm", *(1e3 * value for value in radius))
        for name, one, two in (
            ("hip", f"m1_{short}", f"{limb}_hip"),
            ("pulley joint", f"m2_{short}", f"{limb}_pulley"),
            ("knee", f"knee1_{short}", f"{limb}_knee"),
            ("ankle", f"ankle_{short}", f"{limb}_ankle"),
        ):
            add_joint(f"{pair} {name}", one, two)
        for name, one, two in (
            ("hip", f"m1_{short}", f"{limb}_hip"),
            ("knee", f"m2_{short}", f"{limb}_knee"),
        ):
            rows.extend(
                _servo(f"{limb}_{name}", first.actuator(one), second.actuator(f"{two}_servo"))
            )
    for number, body in enumerate(("t2", "t3", "t4", "hip"), 1):
        joint = second.joint(f"spine_joint_{number}").id
        add_place(f"spine joint {number}", author.data.body(body).xpos, ours.data.xanchor[joint])
        axis, our_axis = author.data.body(body).xmat.reshape(3, 3)[:, 2], -ours.data.xaxis[joint]
        tilt = [
            np.degrees(np.arctan2(-side[1], side[2]))
            for side in (author.frame.T @ axis, ours.frame.T @ our_axis)
        ]
        add(f"spine joint {number}, tilt", "deg", *tilt)
        add_joint(f"spine hinge {number}", body, f"spine_joint_{number}")
    eyelets = ((4, 6), (8, 10), (12, 14), (16, 18))
    joints = [author.data.body(body).xpos for body in ("t2", "t3", "t4", "hip")]
    for number, (ahead, behind) in enumerate(eyelets):
        hinge = ours.data.xanchor[second.joint(f"spine_joint_{number + 1}").id]
        for name, one, two in (("in front", ahead, 2 * number), ("behind", behind, 2 * number + 1)):
            site, our_site = (
                author.data.site(f"s{one}_ss").xpos,
                ours.data.site(f"spine_left_{two}").xpos,
            )
            distance = np.linalg.norm(author.place(site - joints[number] + author.origin)[1:])
            our_distance = np.linalg.norm(ours.place(our_site - hinge + ours.origin)[1:])
            add(
                f"eyelet {name} of spine joint {number + 1}, distance", "mm", distance, our_distance
            )
            add(
                f"eyelet {name} of spine joint {number + 1}, left",
                "mm",
                author.place(site)[0],
                ours.place(our_site)[0],
            )
    add_place(
        "spine pulley", author.data.body("servo_spine").xpos, ours.data.body("spine_pulley").xpos
    )
    add(
        "spine pulley radius",
        "mm",
        1e3 * first.geom("m_ss").size[0],
        1e3 * second.geom("spine_pulley").size[0],
    )
    rows.extend(_servo("spine", first.actuator("spine"), second.actuator("spine_servo")))
    add_place(
        "neck axis",
        author.data.body("mouse_bracket").xpos,
        ours.data.xanchor[second.joint("neck").id],
    )
    rows.extend(_servo("neck", first.actuator("neck"), second.actuator("neck_servo")))
    for number in range(1, 20):
        joint = ours.data.xanchor[second.joint(f"tail_joint_{number}").id]
        add_place(f"tail joint {number}", author.data.body(f"tail_t{number}").xpos, joint)
    add_joint("tail hinge 1", "tail_t1", "tail_joint_1")
    for number, geom in (
        (16, "tail_ground_16"),
        (17, "tail_ground_17"),
        (18, "tail_ground_18"),
        (19, "tail_tip"),
    ):
        bead = author.data.geom(f"tail_t{number}")
        along = bead.xmat.reshape(3, 3)[:, 2] * first.geom(f"tail_t{number}").size[1]
        ends = bead.xpos + along, bead.xpos - along
        end = max(ends, key=lambda point: author.place(point)[1])
        add_place(f"tail segment {number}, end", end, ours.data.geom(geom).xpos)
        add(
            f"tail segment {number}, radius",
            "mm",
            1e3 * first.geom(f"tail_t{number}").size[0],
            1e3 * second.geom(geom).size[0],
        )
    rows.extend(_servo("tail", first.actuator("m1_tail"), second.actuator("tail_servo")))
    for name, one, two in (
        ("front", "m2_tendon_fl", "front_left_tendon"),
        ("rear", "m2_tendon_rl", "rear_left_tendon"),
        ("spine", "m1_tendon_ss", "spine_left"),
    ):
        tendon, ours_tendon = first.tendon(one), second.tendon(two)
        # A limit yields in proportion to the square of the time constant and to the inverse inertia.
        softness = [
            model.tendon_solref_lim[side.id, 0] ** 2 * model.tendon_invweight0[side.id]
            for model, side in ((first, tendon), (second, ours_tendon))
        ]
        add(f"{name} tendon, yield of the limit", "s^2/kg", *softness)
        for entry, part in enumerate(("first impedance", "impedance", "width")):
            add(
                f"{name} tendon, {part}",
                "1",
                first.tendon_solimp_lim[tendon.id, entry],
                second.tendon_solimp_lim[ours_tendon.id, entry],
            )
    contact = next(
        second.pair(i)
        for i in range(second.npair)
        if second.pair(i).name.endswith("front_left_sole")
    )
    for entry, part in enumerate(("time constant", "damping ratio")):
        add(f"contact, {part}", "1", first.opt.o_solref[entry], contact.solref[entry])
    for entry, part in enumerate(("first impedance", "impedance", "width", "midpoint", "power")):
        add(f"contact, {part}", "1", first.opt.o_solimp[entry], contact.solimp[entry])
    add("sole, friction", "1", first.geom("foot_placement_fl2").friction[0], contact.friction[0])
    tip = next(
        second.pair(i) for i in range(second.npair) if second.pair(i).name.endswith("tail_tip")
    )
    add("tail, friction", "1", first.geom("tail_t19").friction[0], tip.friction[0])
    for option in (
        "timestep",
        "impratio",
        "noslip_iterations",
        "noslip_tolerance",
        "cone",
        "integrator",
    ):
        add(f"option {option}", "1", getattr(first.opt, option), getattr(second.opt, option))
    (mass, centre, inertia), (our_mass, our_centre, our_inertia) = (
        author.whole("mouse"),
        ours.whole("torso"),
    )
    add("whole, mass", "kg", mass, our_mass)
    for axis, one, two in zip(("left", "back", "up"), centre, our_centre, strict=True):
        add(f"whole, centre of mass, {axis}", "mm", one, two)
    for axis, one, two in zip(("pitch", "roll", "yaw"), inertia, our_inertia, strict=True):
        add(f"whole, inertia about {axis}", "g cm^2", one, two)
    return rows


def _servo(name: str, first: Any, second: Any) -> list[tuple[str, str, float, float]]:
    """Gain, damping, torque limit and range of a servo."""
    return [
        (f"gain of {name}", "N m/rad", float(first.gainprm[0]), float(second.gainprm[0])),
        (f"damping of {name}", "N m s/rad", float(-first.biasprm[2]), float(-second.biasprm[2])),
        (f"torque limit of {name}", "N m", float(first.forcerange[1]), float(second.forcerange[1])),
        (
            f"range of {name}",
            "deg",
            *(float(np.degrees(side.ctrlrange[1])) for side in (first, second)),
        ),
    ]


def main() -> None:
    folder = Path(sys.argv[1]).resolve() / "models"
    author = Side(author_spec(folder).compile(), "mouse", ("main_leg_fl", "main_leg_fr"))
    robot = load_robot("author", tail="articulated", feet="capsules", simplifications="none")
    model = compile_model(robot, author_body("none"))
    ours = Side(model, "torso", ("front_left_upper", "front_right_upper"))
    table = pd.DataFrame(census(author, ours), columns=["value", "unit", "author", "here"])
    table["difference"] = table["here"] - table["author"]
    scale = np.maximum(table["author"].abs(), 1e-9)
    limit = table["unit"].map(LIMITS).fillna(LIMIT_PERCENT / 100 * scale)
    is_large = table["difference"].abs() > limit + 1e-9
    table["reason"] = [
        next((text for start, text in REASONS.items() if name.startswith(start)), "")
        if large
        else ""
        for name, large in zip(table["value"], is_large, strict=True)
    ]
    table.round(5).to_csv(Path(__file__).with_suffix(".csv"), index=False)
    missing = table[is_large & (table["reason"] == "")]
    print(f"{(~is_large).sum()} of {len(table)} values agree within 0.3 mm, 1 degree or 5 %.")
    print(table[is_large].to_string(index=False))
    if len(missing):
        sys.exit(f"{len(missing)} differences have no reason:\n{missing.to_string(index=False)}")


if __name__ == "__main__":
    main()
