"""The real robot: servo tables of gaits and recorded walks, the servos' channels, and sending angles to the robot."""

from nermo_mjx.hardware.channels import Channel, Channels, read_channels
from nermo_mjx.hardware.live import connected, send_table
from nermo_mjx.hardware.table import ServoTable, recorded_table, servo_table

__all__ = ["Channel", "Channels", "ServoTable", "connected", "read_channels", "recorded_table", "send_table"]
__all__ += ["servo_table"]
