"""The real robot: its logs, servo tables of gaits and recorded walks, channels of servos, and sending angles to it."""

from nermo_mjx.hardware.channels import Channels, ServoChannel, read_channels
from nermo_mjx.hardware.live import connected, send_table
from nermo_mjx.hardware.log import Channel, Log, read_log
from nermo_mjx.hardware.table import ServoTable, recorded_table, servo_table

__all__ = ["Channel", "Channels", "Log", "ServoChannel", "ServoTable", "connected", "read_channels", "read_log"]
__all__ += ["recorded_table", "send_table", "servo_table"]
