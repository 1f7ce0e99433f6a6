# Tests of dynamics/mjx_copy.py
"""MJX and JAX stay unchanged in a process that imports or uses this package: other models keep their results."""

from __future__ import annotations

import ast
import os
import subprocess
import sys

import pytest

#: Compares all attributes of the loaded modules of MJX and JAX by identity, at two times, with the entries of
#: dictionaries and the attributes of classes. New entries count in MJX only: JAX itself registers in its own tables.
#: `replaced` also lists attributes that were replaced and restored, which another thread would see.
WATCH = """
import importlib, pkgutil, sys, types
import jax, jax.export, jax.numpy as jnp, mujoco
from mujoco import mjx

def watched():
    return [name for name in sys.modules if name.split(".")[0] in ("jax", "jaxlib") or name.startswith("mujoco.mjx")]

def attributes(module):
    found = {}
    for name, value in list(vars(module).items()):
        found[name] = value
        if isinstance(value, dict) and not name.startswith("__"):
            found.update({f"{name}[{key!r}]": each for key, each in list(value.items())})
        if isinstance(value, type) and value.__module__ == module.__name__:
            found.update({f"{name}.{key}": each for key, each in vars(value).items()})
    return found

replaced = set()

class Watched(types.ModuleType):
    def __setattr__(self, name, value):
        if name in vars(self) and vars(self)[name] is not value:
            replaced.add(f"{self.__name__}.{name}")
        super().__setattr__(name, value)

class Changes:
    def __init__(self):
        self.before = {name: attributes(sys.modules[name]) for name in watched()}
        for name in self.before:
            if type(sys.modules[name]) is types.ModuleType:
                sys.modules[name].__class__ = Watched

    def __call__(self):
        changed = set(replaced)
        for module, before in self.before.items():
            after = attributes(sys.modules[module])
            changed |= {f"{module}.{name}" for name in before if after.get(name, None) is not before[name]}
            if module.startswith("mujoco.mjx"):
                new = set(after) - set(before)
                changed |= {f"{module}.{name}" for name in new if not isinstance(after[name], types.ModuleType)}
        return sorted(changed)
"""

IMPORT = """
changes = Changes()
import nermo_mjx
for module in pkgutil.walk_packages(nermo_mjx.__path__, "nermo_mjx."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            assert not error.name.startswith("nermo_mjx"), error
print(changes())
"""


def printed(*parts: str) -> list[str]:
    """Lines that a program prints in a new process, without a cache of programs, which JAX keeps in its modules."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": ""}
    process = subprocess.run(
        [sys.executable, "-c", "\n".join(parts)], text=True, capture_output=True, env=environment
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.splitlines()


@pytest.mark.release
def test_importing_all_modules_replaces_no_attribute_of_mjx_or_jax() -> None:
    assert ast.literal_eval(printed(WATCH, IMPORT)[-1]) == []


#: A cylinder, a box and a capsule that fall on a plane: kinds of geoms for which the package has custom contacts.
FALLING = """
model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody><geom type="plane" size="2 2 .1"/>
<body pos="0 0 .3"><freejoint/><geom type="cylinder" size=".05 .1" euler="70 20 0" contype="2"/></body>
<body pos=".5 0 .3"><freejoint/><geom type="box" size=".05 .07 .1" euler="40 20 0" contype="2"/></body>
<body pos="-.5 0 .3"><freejoint/><geom type="capsule" size=".05 .1" euler="88 20 0" contype="2"/></body>
</worldbody></mujoco>''')
"""
#: A tendon around a cylinder, a muscle, a weld and a ball joint with a limit: the step replaces functions of MJX there.
HELD = """
held = mujoco.MjModel.from_xml_string('''<mujoco><option integrator="implicitfast"/><default>
<geom contype="0" conaffinity="0"/></default><worldbody><site name="a" pos="0 0 .1"/>
<geom name="drum" type="cylinder" size=".03 .05" pos=".02 0 .02" euler="90 0 0"/>
<body name="arm"><joint name="j" axis="0 1 0"/><geom type="capsule" fromto=".1 0 0 .3 0 0" size=".01" mass=".1"/>
<site name="b" pos=".12 0 .01"/></body>
<body name="ball" pos="0 1 0"><joint type="ball" range="0 1" limited="true" stiffness=".1"/><geom size=".1"/></body>
<body name="box" pos="0 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody>
<tendon><spatial name="t"><site site="a"/><geom geom="drum"/><site site="b"/></spatial></tendon>
<equality><weld body1="arm" body2="box"/></equality>
<actuator><muscle tendon="t" lengthrange="0 1"/></actuator></mujoco>''')
"""
USE = """
plain = mjx.put_model(held)
jax.eval_shape(mjx.step, plain, mjx.make_data(plain))
jax.jit(lambda x: x + 1.0)(0.0)
changes = Changes()
from nermo_mjx import Simulator
from nermo_mjx.dynamics import PlaceConstants, make_data, put_model, step
Simulator(engine="mjx")
device = put_model(held)
jax.eval_shape(step, device, make_data(device))
jax.eval_shape(PlaceConstants(held), {"body_pos": device.body_pos})
print(changes())
"""

PLAIN = """
import numpy as np

def run():
    device = mjx.put_model(model)
    data = mjx.make_data(device)
    walk = jax.jit(lambda data: jax.lax.scan(lambda each, _: (mjx.step(device, each), None), data, None, length=400)[0])
    after = walk(data)
    return [np.asarray(after.qpos), data._impl.ncon, type(device)]

before = run()
from nermo_mjx.dynamics import step
after = run()
print(np.abs(after[0] - before[0]).max(), before[1:] == after[1:], before[1])
"""


@pytest.mark.release
def test_simulators_and_steps_replace_no_attribute_of_mjx_or_jax_even_while_they_are_traced() -> (
    None
):
    """Another thread that traces `mjx.step` at the same time would otherwise get other physics."""
    assert ast.literal_eval(printed(WATCH, HELD, USE)[-1]) == []


@pytest.mark.release
def test_a_model_of_plain_mjx_moves_alike_before_and_after_the_import() -> None:
    """With the same number of contacts, nine: a cylinder has three in MJX, and four in this package."""
    assert printed("import jax, mujoco\nfrom mujoco import mjx", FALLING, PLAIN)[-1] == "0.0 True 9"
