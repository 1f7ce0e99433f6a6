"""Visualisation of runs: recordings, videos, and a page for the browser."""

from nermo_mjx.recording import Recording, RecordingError, model_hash, recording_of
from nermo_mjx.view.overlays import OVERLAYS
from nermo_mjx.view.page import Page, show
from nermo_mjx.view.playing import play, write_keyframes
from nermo_mjx.view.recorded import robot_of, shown_model
from nermo_mjx.view.video import CAMERAS, VideoError, check_video, render

__all__ = [
    "CAMERAS",
    "OVERLAYS",
    "Page",
    "Recording",
    "RecordingError",
    "VideoError",
    "check_video",
    "model_hash",
    "play",
    "recording_of",
    "render",
    "robot_of",
    "show",
    "shown_model",
    "write_keyframes",
]
