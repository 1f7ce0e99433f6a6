"""The robot: its numbers, its assembled MuJoCo model, and the meaning of its indices."""

from nermo_mjx.robot.assembly import RobotConfig, assemble, assemble_leg, assemble_spine
from nermo_mjx.robot.geometry import Geometry
from nermo_mjx.robot.masses import MassModel
from nermo_mjx.robot.model_parameters import ModelParameters
from nermo_mjx.robot.parameters import GAIT_CODES, GAITS, LIMBS, SERVOS, Sensors, ServoAngles
from nermo_mjx.robot.quantity import ParameterError, Quantity
from nermo_mjx.robot.robot import JointIndex, Robot, load_robot
from nermo_mjx.robot.terrains import gates

__all__ = [
    "GAITS",
    "GAIT_CODES",
    "LIMBS",
    "SERVOS",
    "Geometry",
    "JointIndex",
    "MassModel",
    "ModelParameters",
]
__all__ += [
    "ParameterError",
    "Quantity",
    "Robot",
    "RobotConfig",
    "Sensors",
    "ServoAngles",
    "assemble",
    "assemble_leg",
]
__all__ += ["assemble_spine", "gates", "identified", "load_robot"]
