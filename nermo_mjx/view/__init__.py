"""What users see of a run: recordings and videos."""

from nermo_mjx.view.recording import Recording, RecordingError, model_hash, recording_of
from nermo_mjx.view.video import CAMERAS, VideoError, render

__all__ = ["CAMERAS", "Recording", "RecordingError", "VideoError", "model_hash", "recording_of", "render"]
