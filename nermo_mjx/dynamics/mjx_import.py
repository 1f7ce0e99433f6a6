"""MJX, imported once and quietly: on import it prints to stdout that warp is missing, which would spoil `--json`."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
