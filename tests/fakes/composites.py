"""Models in the place of MJX's `arm26` and of its cables, whose composites MuJoCo 4 no longer compiles."""

from __future__ import annotations


def mjcf(world: str, sections: str = "", option: str = "") -> str:
    return f"<mujoco><option {option}/><worldbody>{world}</worldbody>{sections}</mujoco>"


WOUND = """<site name="over" pos="-.2 0 1.1"/><site name="under" pos="-.2 0 .9"/><body pos="0 0 1">
  <joint name="a" axis="0 1 0" range="-60 60" limited="true" damping=".1"/>
  <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
  <geom name="round" type="cylinder" size=".05 .1" zaxis="0 1 0" contype="0" conaffinity="0"/>
  <site name="above" pos="0 0 .07"/><site name="below" pos="0 0 -.07"/><site name="near" pos=".2 0 .04"/>
  <body pos=".3 0 0"><joint name="b" axis="0 1 0" range="-60 60" limited="true" damping=".1"/>
    <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/><site name="far" pos=".1 0 .04"/></body></body>"""
MUSCLES = """<tendon><spatial name="upper"><site site="over"/><geom geom="round" sidesite="above"/><site site="near"/>
  <site site="far"/></spatial><spatial name="lower"><site site="under"/><geom geom="round" sidesite="below"/>
  <site site="near"/></spatial></tendon><actuator><muscle tendon="upper" ctrlrange="0 1" lengthrange=".3 .8"/>
  <muscle tendon="lower" ctrlrange="0 1" lengthrange=".2 .7"/></actuator>"""
LINK = """<body name="link{}" pos=".1 0 0"><joint type="ball" damping=".01"/>
  <geom type="capsule" size=".02" fromto="0 0 0 .1 0 0"/>"""
#: Muscles that are wound round a joint and past a second one, and a chain of ball joints between two points.
IN_THEIR_PLACE = {
    "muscles wound round a joint": mjcf(WOUND, MUSCLES),
    "a rope": mjcf(
        "".join(map(LINK.format, range(6))) + "</body>" * 6,
        '<equality><connect body1="link5" anchor=".1 0 0"/></equality>',
    ),
}
