"""Assembly of the robot, and of its test stands, from the MJCF files of `mjcf/`.

A part is one of these files, such as the torso or a left leg; it contains bodies, joints and visuals. `load_part` reads a
part and writes the geometry into it. This module attaches the parts to each other; the right limbs are mirrored left
limbs. `nermo_mjx.robot.equipment` then adds masses, joint parameters, tendons, servos, sensors and contacts.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final, Literal

import mujoco
import numpy as np

from nermo_mjx.robot.equipment import (
    MAX_HINGES,
    TAIL_SEGMENTS,
    add_contacts,
    add_hinges,
    add_sensors,
    add_servos,
    chain_of,
    place_hinges,
    set_joints,
    set_masses,
    set_tendons,
)
from nermo_mjx.robot.geometry import Geometry, standing
from nermo_mjx.robot.masses import mass_values
from nermo_mjx.robot.model_parameters import ModelParameters, gravity_vector
from nermo_mjx.robot.parameters import (
    LEGS,
    LIMBS,
    NOSLIP_ITERATIONS,
    PRESETS,
    SIMPLIFICATIONS,
    PhysicsPreset,
    PresetName,
    PresetTimestep,
    ProfileChoice,
    RoutingName,
)
from nermo_mjx.robot.parts import load_part, mirror, stance_height
from nermo_mjx.robot.quantity import (
    ParameterError,
    allowed_names,
    choice,
    of_type,
    replace_quantities,
    static,
    with_attributes,
)
from nermo_mjx.robot.scene import Scene, load_scene, resolve_scene, scene_geoms, scene_name

RobotName = Literal["nermo_lite", "nermo_41", "author"]
TailName = Literal["rigid", "articulated"]
ConeName = Literal["elliptic", "pyramidal"]
FeetName = Literal["spheres", "capsules"]
#: The torso's cameras that follow the robot without turning with it.
FOLLOWING_CAMERAS: Final = ("track_side", "track_top", "track_three_quarter")
#: The two cameras of the head.
EYE_CAMERAS: Final = ("left_eye", "right_eye")


@with_attributes
@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """Static choices of the robot's model; all names are checked before anything is compiled."""

    robot: RobotName = static(
        ProfileChoice("nermo_lite"),
        "`nermo_41` has vertical spine joints, and a head that tilts; `author` is Nermo-Lite as in the author's model, "
        "which as_published takes in place of nermo_lite",
    )
    scene: Scene = static(
        "flat",
        "a scene of mjcf/scenes, or a custom one as the path of an MJCF file or as MJCF itself, which is stored",
    )
    tail: TailName = static(
        ProfileChoice("rigid"),
        "rigid is a third faster, articulated has 19 joints; same mass and centre of mass; in as_published by default "
        "articulated",
    )
    routing: RoutingName = static(
        "type3",
        "of the knee's tendon: type3 through the hip axis (the robot), type3_idler around an idler on that axis; see "
        "`robot.geometry.pull`",
    )
    cone: ConeName = static("elliptic", "friction cone")
    physics: PresetName = static("reference", "time step and contact pairs, see `PRESETS`")
    timestep: float = static(
        PresetTimestep("nan"),
        "physics step [s]: the control period 0.01 s divided by a whole number; takes precedence over that of physics",
    )
    feet: FeetName = static(
        ProfileChoice("spheres"),
        "form of the soles; capsules: 7 mm wide, and front ankles touch, too; in as_published by default capsules",
    )
    hinges: int = static(
        1, f"of each compliant joint of legs and spine, from 1 to {MAX_HINGES}; see `flexure`"
    )
    simplifications: str = static(
        "contact+noslip",
        "of the robot author, none or several joined by +: servos with less gain and with damping, contact whose force "
        "begins at zero, and noslip, without iterations against slip (the engine mjx needs it)",
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "scene", resolve_scene(self.scene))
        for name, allowed in allowed_names(type(self)).items():  # type: ignore[arg-type]
            choice(name, getattr(self, name), allowed)
        if isinstance(self.timestep, PresetTimestep):
            object.__setattr__(self, "timestep", PresetTimestep(self.preset.timestep))
        if not 1e-5 <= self.timestep <= 0.005:
            raise ParameterError(f"timestep is {self.timestep!r}: allowed is [1e-05, 0.005] s.")
        if type(self.hinges) is not int or not 1 <= self.hinges <= MAX_HINGES:
            raise ParameterError(
                f"hinges is {self.hinges!r}: allowed is a whole number from 1 to {MAX_HINGES}."
            )
        for name in self.simplified:
            choice("simplifications", name, ("none", *SIMPLIFICATIONS))
        if self.robot != "author" and self.simplifications != RobotConfig.simplifications:
            raise ParameterError(
                f"simplifications is {self.simplifications!r} with robot {str(self.robot)!r}: it goes with robot 'author'."
            )

    @property
    def simplified(self) -> frozenset[str]:
        """The names that `simplifications` joins."""
        return frozenset(of_type("simplifications", self.simplifications, str, "a name").split("+"))

    @property
    def preset(self) -> PhysicsPreset:
        """The preset that `physics` names."""
        return PRESETS[self.physics]


def assemble(
    config: RobotConfig | None = None, parameters: ModelParameters | None = None
) -> mujoco.MjSpec:
    """The whole robot in its scene, as an editable `MjSpec`.

    Args:
        config: Choices of the model; the default robot on flat ground by default.
        parameters: Parameters of the robot and of gravity; by default those of the robot, with the gravity of the scene.
    """
    config = config or RobotConfig()
    scene = str(config.scene)
    spec = load_scene(scene)
    if parameters is None:
        parameters = default_parameters(config.robot)
    else:
        ground = parameters.ground
        spec.option.gravity = gravity_vector(ground.gravity, ground.slope, ground.direction)
    geometry = parameters.geometry
    robot = config.robot
    spec.modelname = f"{robot}_{scene_name(scene)}"
    _attach(
        spec,
        geometry,
        spec.worldbody,
        "torso",
        robot,
        plain=("torso", "root", "imu", *FOLLOWING_CAMERAS),
    )
    _attach(spec, geometry, spec.frame("torso_spine_mount"), "spine", robot, hinges=config.hinges)
    eyes = ("head", "neck", "head_tilt", "eyes", *EYE_CAMERAS)
    _attach(spec, geometry, spec.frame("torso_neck_mount"), "head", robot, plain=eyes)
    _attach(spec, geometry, spec.frame("spine_end"), "hip", robot)
    for limb in LIMBS:
        trunk = "torso" if limb.startswith("front") else "hip"
        _attach_leg(spec, parameters, spec.frame(f"{trunk}_{limb}_mount"), limb, config)
    rigid = config.tail == "rigid"
    _attach(spec, geometry, spec.frame("hip_tail_mount"), "tail", robot, stiff=rigid)
    spec.compiler.fusestatic |= rigid
    _pose(spec, config)
    _finish(spec, config, parameters)
    add_sensors(spec)
    add_contacts(
        spec,
        scene_geoms(scene),
        parameters,
        config.preset.trunk_contacts,
        config.feet == "capsules",
        config.robot != "author" or "contact" in config.simplified,
    )
    return spec


def assemble_leg(
    limb: str,
    routing: RoutingName = "type3",
    parameters: ModelParameters | None = None,
    hinges: int = 1,
) -> mujoco.MjSpec:
    """One leg on a test stand: its hip axis is fixed at the world's origin, without gravity or ground."""
    choice("limb", limb, LIMBS)
    config = RobotConfig(routing=routing, hinges=hinges)
    parameters = parameters or ModelParameters()
    spec = _stand(f"{limb}_leg_stand")
    _attach_leg(spec, parameters, spec.worldbody, limb, config)
    _pose(spec, config)
    _finish(spec, config, parameters)
    return spec


def assemble_spine(
    parameters: ModelParameters | None = None, robot: RobotName = "nermo_lite", hinges: int = 1
) -> mujoco.MjSpec:
    """The spine on a test stand: its base is fixed at the world's origin, without gravity; the hip hangs free."""
    config, parameters = RobotConfig(robot, hinges=hinges), parameters or default_parameters(robot)
    spec, geometry = _stand("spine_stand"), parameters.geometry
    _attach(spec, geometry, spec.worldbody, "spine", robot, hinges=hinges)
    _attach(spec, geometry, spec.frame("spine_end"), "hip", robot)
    _finish(spec, config, parameters)
    return spec


def default_parameters(robot: str) -> ModelParameters:
    """The default parameters of a robot's model, with the masses of this robot."""
    return replace_quantities(ModelParameters(), mass_values(robot))


def _stand(name: str) -> mujoco.MjSpec:
    """An empty test stand without gravity."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.option.gravity = np.zeros(3)
    return spec


def _attach(
    spec: mujoco.MjSpec,
    geometry: Geometry,
    attachment_site: Any,
    name: str,
    robot: str,
    plain: tuple[str, ...] = (),
    hinges: int = 1,
    stiff: bool = False,
) -> None:
    """Attach a part of the robot to the robot so far, with the name of the part as the prefix of its elements.

    Args:
        spec: Robot so far.
        geometry: Lengths and positions of the robot.
        attachment_site: Frame of the robot so far at which the part is attached, or a body.
        name: Name of the part.
        robot: Name of the robot.
        plain: Names of elements that are stored without the prefix, if the part contains them.
        hinges: Number of hinges of each joint of the spine.
        stiff: Whether to remove the joints of the part, which must be the tail.
    """
    frame = (
        attachment_site
        if isinstance(attachment_site, mujoco.MjsFrame)
        else attachment_site.add_frame()
    )
    part = load_part(name, geometry, robot)
    if name == "spine":
        add_hinges(part, hinges)
    if stiff:
        _stiffen_tail(part)
    spec.attach(part, prefix=f"{name}_", frame=frame)
    for kind in (spec.body, spec.joint, spec.site, spec.frame, spec.camera):
        for short in plain:
            element = kind(f"{name}_{short}")
            if element is not None:
                element.name = short


def _attach_leg(
    spec: mujoco.MjSpec,
    parameters: ModelParameters,
    attachment_site: Any,
    limb: str,
    config: RobotConfig,
) -> None:
    """Attach a leg with the knee tendon of one routing; a right leg is a mirrored left leg.

    The file of a leg contains one tendon for each routing, named after the routing.
    """
    pair, side = limb.split("_")
    leg = load_part(f"{pair}_leg", parameters.geometry)
    for tendon in list(leg.tendons):
        if tendon.name != config.routing:
            leg.delete(tendon)
        else:
            tendon.name = "tendon"
    if config.routing != "type3_idler":
        for element in (leg.geom("idler"), *map(leg.site, ("lead", "idler_side", "rim_idler"))):
            leg.delete(element)
    add_hinges(leg, config.hinges)
    if side == "right":
        mirror(leg)
    frame = (
        attachment_site
        if isinstance(attachment_site, mujoco.MjsFrame)
        else attachment_site.add_frame()
    )
    half = float(getattr(parameters.build, f"{pair}_tilt")) / 2
    frame.quat = np.array([np.cos(half), np.sin(half), 0.0, 0.0])
    spec.attach(leg, prefix=f"{limb}_", frame=frame)


def _stiffen_tail(tail: mujoco.MjSpec) -> None:
    """Delete the joints of the tail, so that the compiler fuses its segments with the hip at their present positions.

    Only the contact of the tip with the ground remains, because the tip touches first. The elements are deleted before
    the part is attached, because this is much faster than in the whole robot.
    """
    for geom, site in TAIL_SEGMENTS:
        tail.delete(tail.geom(geom.removeprefix("tail_")))
        tail.delete(tail.site(site.removeprefix("tail_")))
    for element in (*tail.tendons, *tail.joints):
        tail.delete(element)


def _pose(spec: mujoco.MjSpec, config: RobotConfig) -> None:
    """Make the published stance the reference pose of the model (`qpos0`).

    MuJoCo computes its reference inertias in this pose. A joint value of 0 still means the straight leg. The angles,
    rounded to 0.1 mrad, do not depend on the geometry, so that every value in the model is linear in the geometry.
    """
    for pair, leg in LEGS.items():
        hip, knee, pulley = (round(angle, 4) for angle in standing(leg, config.routing))
        for joint in spec.joints:
            kind = chain_of(joint.name).rsplit("_", 1)[-1]
            angle = {"hip": hip, "knee": knee, "pulley": pulley}.get(kind)
            if joint.name.startswith(pair) and angle is not None:
                turn = angle * joint.axis[0]
                joint.parent.quat = np.array([np.cos(turn / 2), np.sin(turn / 2), 0.0, 0.0])
                joint.ref = angle / config.hinges if kind == "knee" else angle
    torso = spec.body("torso")
    if torso is not None:
        torso.pos = np.array([0.0, 0.0, stance_height(Geometry())])


def _finish(spec: mujoco.MjSpec, config: RobotConfig, parameters: ModelParameters) -> None:
    """Set the options of the physics, and write all values of the parameters into the model."""
    option = spec.option
    option.timestep = config.timestep
    # The integrator Euler treats the damping of the joints, which is stiff, implicitly, and the damping of the servos
    # explicitly. With implicitfast, the engines would differ while a servo is saturated: MJX keeps the derivative of the
    # servo's damping, and MuJoCo C omits it.
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{config.cone.upper()}")
    option.impratio = 3.0
    # Without the automatic reset, a diverged world stays diverged, so that it can be reported. Without the search for
    # islands, a step takes 4 % less time and has bit-identical forces, because one robot is one island.
    option.disableflags |= (
        mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_ISLAND
    )
    place_hinges(spec, config.hinges)
    set_masses(spec, config.robot, parameters)
    set_joints(spec, parameters, config.hinges)
    set_tendons(spec, parameters, config.robot)
    if config.robot == "author" and "noslip" not in config.simplified:
        option.noslip_iterations, option.noslip_tolerance = NOSLIP_ITERATIONS, 1e-8
    add_servos(spec, config.routing, parameters, config.robot, "servos" in config.simplified)
