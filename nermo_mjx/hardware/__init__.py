"""The real robot: its logs, servo tables of gaits and recorded walks, channels of servos, and sending angles to it."""

from nermo_mjx.hardware.channels import Channels, ServoChannel, read_channels
from nermo_mjx.hardware.live import connected, send_table
from nermo_mjx.hardware.log import Channel, Log, read_log
from nermo_mjx.hardware.signals import findings_of
from nermo_mjx.hardware.table import ServoTable, recorded_table, servo_table
from nermo_mjx.hardware.twin import replay_log, with_log

__all__ = [
    "Channel",
    "Channels",
    "Log",
    "ServoChannel",
    "ServoTable",
    "connected",
    "findings_of",
    "read_channels",
]
__all__ += ["read_log", "recorded_table", "replay_log", "send_table", "servo_table", "with_log"]
