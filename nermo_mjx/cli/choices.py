"""Names that options allow, written out so that `--help` needs no import; a test holds them equal to their sources."""

from __future__ import annotations

ENGINES = ("auto", "c", "mjx", "warp")
GRADIENT_MODES = ("forward", "reverse")
BENCH_CASES = ("throughput", "gradient", "tuning", "startup", "profile", "speedtest")
ROBOTS = ("nermo_lite",)
TAILS = ("rigid", "articulated")
PHYSICS = ("reference", "fast")
GAITS = ("trt", "trt1", "lat")
SPINE_MODES = ("none", "stride_extension", "balance")
STEERINGS = ("leg", "spine", "mix")
PROFILES = ("exact", "as_published")
EXPERIMENTS = ("straight-line", "turning", "balance", "maze")
PILOTS = ("straight", "arc", "open_loop")
OVERLAYS = ("gait", "servos", "support")
VIEWS = ("three_quarter", "high", "side", "top", "front", "rear")
