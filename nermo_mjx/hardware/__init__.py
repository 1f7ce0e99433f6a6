"""The real robot: servo tables of a gait, and the channels that servos hang on."""

from nermo_mjx.hardware.channels import Channel, Channels, read_channels
from nermo_mjx.hardware.table import ServoTable, servo_table

__all__ = ["Channel", "Channels", "ServoTable", "read_channels", "servo_table"]
