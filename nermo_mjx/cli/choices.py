"""Names that options allow, written out so that `--help` needs no import; a test holds them equal to their sources."""

from __future__ import annotations

ENGINES = ("auto", "c", "mjx", "warp")
GRADIENT_MODES = ("forward", "reverse")
BENCH_CASES = ("throughput", "gradient", "startup")
ROBOTS = ("nermo_lite", "nermo_41")
TAILS = ("rigid", "articulated")
PHYSICS = ("reference", "fast")
GAITS = ("trt", "trt1", "lat", "bound", "gallop")
SPINE_MODES = ("none", "stride_extension", "balance", "harmonics", "sagittal_extension", "pitch_balance")
TRAJECTORIES = ("cubic", "linear", "parabolic", "free")
HEADS = ("none", "gaze")
TAIL_MOTIONS = ("none", "swing", "counter_yaw", "counter_roll")
STEERINGS = ("leg", "spine", "mix")
SIMULATED = ("exact", "as_published")
PROFILES = (*SIMULATED, "as_built")
EXPERIMENTS = ("straight-line", "turning", "balance", "maze", "body", "leg-stand", "spine-stand")
PILOTS = ("straight", "arc", "open_loop")
OVERLAYS = ("gait", "servos", "support")
VIEWS = ("three_quarter", "high", "side", "top", "front", "rear")
FORMATS = ("png", "svg")
SCENES = (
    "balance_stand", "flat", "maze", "quarter_circles", "straight_line", "planks", "ramp", "logs", "stairs",
    "spiral_stairs", "rough", "slalom",
)  # fmt: skip
PAIRS_AND_LIMBS = ("front", "rear", "front_left", "front_right", "rear_left", "rear_right")
METRICS = (
    "speed", "distance", "duration", "lateral_drift", "roll_mean", "roll_std", "roll_min", "roll_max", "pitch_mean",
    "pitch_std", "pitch_min", "pitch_max", "yaw_mean", "yaw_std", "yaw_min", "yaw_max", "head_pitch_mean",
    "head_pitch_std", "head_yaw_mean", "head_yaw_std", "picture_motion", "cross_track_peak",
    "cross_track_rms", "cross_track_walked", "turning_radius", "turn_rate", "slip", "slip_front_left",
    "slip_front_right", "slip_rear_left", "slip_rear_right", "duty_front_left", "duty_front_right", "duty_rear_left",
    "duty_rear_right", "loaded_front", "loaded_rear", "swing_loaded_front", "swing_loaded_rear", "load_front_left",
    "load_front_right", "load_rear_left", "load_rear_right", "front_load_share", "tail_time", "tail_load_share",
    "servo_work", "cost_of_transport", "motor_current", "servo_current", "electrical_power", "charge", "battery_time",
    "fell", "diverged", "failure_time",
)  # fmt: skip
PARAMETERS = (
    "frequency", "stride", "duty", "gait_factor", "speed", "offset.front_left", "offset.front_right",
    "offset.rear_left", "offset.rear_right", "stance.front_y", "stance.front_z", "stance.rear_y", "stance.rear_z",
    "stance.swing_amplitude", "stance.stance_amplitude", "stance.max_stride", "spine.amplitude", "spine.phase",
    "spine.max_servo_angle", "spine.fusion_exponent", "spine.offset_compensation", "spine.offset_at_feet",
    "spine.balance_lift",
    "spine.sagittal_amplitude", "spine.sagittal_phase", "spine.pitch_gain", "spine.pitch_damping",
    *(f"spine.harmonics.{part}{order}" for order in range(1, 7) for part in ("cos", "sin")),
    *(f"limb.{what}.{limb}" for what in ("stride", "lift", "duty", "phase") for limb in PAIRS_AND_LIMBS),
    *(f"foot.{limb}.{axis}{point}" for limb in PAIRS_AND_LIMBS for axis in "yz" for point in range(1, 9)),
    "trim.spine", *(f"trim.{servo}.{limb}" for servo in ("hip", "knee") for limb in PAIRS_AND_LIMBS),
    "turning.exponent", "turning.leg", "turning.spine", "pilot.guidance", "pilot.look_ahead", "pilot.damping",
    "pilot.bandwidth", "pilot.grip", "pilot.error_gain", "pilot.change_gain", "pilot.output_limit",
    "pilot.turn_rate", "pilot.radius", "pilot.direction", "head.pan", "head.tilt", "head.into_turn", "head.gain",
    "head.bandwidth", "head.lead", "tail.angle", "tail.swing_amplitude", "tail.swing_gain", "tail.swing_phase",
    "tail.yaw_gain", "tail.roll_gain", "tail.bandwidth", "tracking.foot_gain", "tracking.clock_ratio", "servo.kp",
    "servo.kv", "servo.torque_limit", "servo.spine_torque", "servo.speed",
    "servo.supply_voltage", "servo.back_emf", "servo.dead_band", "servo.backlash", "servo.idle_current",
    "servo.stall_current", "battery.capacity", "battery.electronics_current", "contact.friction",
    "contact.tail_friction", "contact.trunk_friction", "contact.obstacle_friction",
    "contact.time_constant", "contact.damping_ratio", "contact.impedance", "contact.width", "stiffness.front_knee",
    "stiffness.rear_knee", "stiffness.ankle", "stiffness.spine", "damping.hip", "damping.knee", "damping.ankle",
    "damping.spine", "damping.pulley", "mass.front", "mass.rear", "build.leg_slack", "build.spine_slack",
    "build.asymmetry", "ground.gravity", "ground.slope", "ground.direction",
    *(f"geometry.{pair}_leg.{link}" for pair in ("front", "rear") for link in ("upper", "attachment", "lower", "foot")),
    *(f"geometry.{place}.{axis}" for place in ("shoulder", "hip") for axis in "xyz"), "geometry.foot.radius",
    "geometry.spine.segment", "geometry.spine.pulley_radius", "geometry.tail.length",
    "terrain.height", "terrain.spacing", "terrain.width", "terrain.radius", "terrain.slope", "terrain.gap",
    "terrain.offset", "terrain.shift", "terrain.side", "start.x", "start.y", "start.yaw", "start.phase",
)  # fmt: skip
