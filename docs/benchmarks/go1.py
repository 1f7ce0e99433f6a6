"""A Unitree Go1 that learns to follow a commanded velocity by plain PPO on `mujoco.batch`, beside our own trainings.

    python docs/benchmarks/go1.py GO1.xml --seeds 0 1 2 3 4 --out go1.jsonl

GO1.xml is MuJoCo Menagerie's unitree_go1/go1.xml; its meshes are not needed. 1,024 robots step 24 ticks of 20 ms (five
steps of 4 ms) between updates. As in the usual recipes the reward is for tracking, a trot by a clock, and few jerks.
Every 15 s of the clock 100 robots walk 10 s at 1 m/s: a success does not fall and keeps at least 80 % of the speed.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
from mujoco.batch import Batch

WORLDS, TICKS, EPOCHS, PARTS, DECIMATION, TICK = 1024, 24, 5, 4, 5, 0.02
FEET, OFFSET, CLOCK = ("FR", "FL", "RR", "RL"), (0.0, 0.5, 0.5, 0.0), 2.0
STAND = (0.1, 0.9, -1.8, -0.1, 0.9, -1.8) * 2
GAMMA, LAMBDA, CLIP, ENTROPY, OBSERVED, ACTED = 0.99, 0.95, 0.2, 0.005, 50, 12


def go1(path: str) -> mujoco.MjModel:
    """The robot on a plane: only feet touch it."""
    spec = mujoco.MjSpec.from_file(path)
    for geom in list(spec.geoms):
        if geom.name in FEET:
            geom.condim, geom.margin, geom.solimp = 3, 0.0, [0.9, 0.95, 0.001, 0.5, 2.0]
        else:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1])
    option = spec.option
    option.timestep, option.iterations, option.solver = TICK / DECIMATION, 10, mujoco.mjtSolver.mjSOL_PGS
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_PYRAMIDAL
    for joint in spec.joints[1:]:
        joint.damping, joint.frictionloss = [0.0, 0.0, 0.0], 0.0
        joint.armature = 0.000112 * (9 if "calf" in joint.name else 6) ** 2
    for actuator in spec.actuators:
        actuator.set_to_position(kp=35.0, kv=0.5)
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    kinds, site, body = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_XBODY
    spec.add_sensor(name="gyro", type=kinds.mjSENS_GYRO, objtype=site, objname="imu")
    spec.add_sensor(name="velocity", type=kinds.mjSENS_VELOCIMETER, objtype=site, objname="imu")
    up = {"objtype": body, "objname": "world", "reftype": body, "refname": "trunk"}
    spec.add_sensor(name="up", type=kinds.mjSENS_FRAMEZAXIS, **up)
    for foot in FEET:
        spec.add_sensor(name=foot, type=kinds.mjSENS_FRAMELINVEL, objtype=site, objname=foot)
        spec.add_sensor(name=f"{foot} force", type=kinds.mjSENS_TOUCH, objtype=site, objname=foot)
    return spec.compile()


class Worlds:
    """Robots with their commands: forward, sideways [m/s] and yaw [rad/s]."""

    def __init__(self, model: mujoco.MjModel, number: int, seed: int, command: Any = None) -> None:
        self.batch, self.fixed, self.random = Batch(model, number), command, np.random.default_rng(seed)
        self.qpos, self.qvel, self.ctrl = (self.batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        self.friction, self.feet = self.batch.expand("geom_friction"), [model.geom(foot).id for foot in FEET]
        self.ends = 0.95 * model.jnt_range[1:].T
        self.age, self.clock, self.command = np.zeros(number, int), np.zeros(number), np.zeros((number, 3))
        self.action, self.down = np.zeros((number, ACTED)), np.ones((number, 4), bool)
        self.reset(np.arange(number))

    def reset(self, ids: np.ndarray) -> None:
        """Standing, from slightly different poses, on ground of friction 0.4 to 1."""
        count = len(ids)
        self.batch.reset(ids, keyframe=0)
        self.qpos[ids, 7:] = STAND + self.random.uniform(-0.1, 0.1, (count, ACTED))
        self.friction[ids[:, None], self.feet, 0] = self.random.uniform(0.4, 1.0, (count, 1))
        self.batch.forward(ids)
        self.qpos[ids, 2] -= self.sites[ids].min(1) - 0.001
        self.batch.forward(ids)
        self.clock[ids], self.age[ids], self.action[ids], self.down[ids] = self.random.random(count), 0, 0.0, True
        self.order(ids)

    def order(self, ids: np.ndarray) -> None:
        drawn = self.random.uniform(-1, 1, (len(ids), 3)) * (1.5, 0.8, 1.2)
        drawn *= self.random.random((len(ids), 3)) < (0.9, 0.25, 0.5)
        self.command[ids] = drawn if self.fixed is None else self.fixed

    @property
    def sites(self) -> np.ndarray:
        return np.stack([self.batch.site(foot).xpos[:, 2] for foot in FEET], 1) - 0.023

    def sensor(self, name: str) -> np.ndarray:
        return np.array(self.batch.sensor(name).data)

    def observe(self) -> np.ndarray:
        angle = 2 * np.pi * self.clock[:, None]
        parts = (
            self.sensor("velocity"),
            self.sensor("gyro"),
            self.sensor("up"),
            self.qpos[:, 7:] - STAND,
            self.qvel[:, 6:],
            self.action,
            self.command,
            np.sin(angle),
            np.cos(angle),
        )
        return np.concatenate(parts, 1, dtype=np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rewards, and who fell."""
        self.ctrl[:] = STAND + 0.5 * action
        landing = np.stack([self.sensor(foot) for foot in FEET], 1)
        self.batch.step(nstep=DECIMATION)
        self.age += 1
        self.order(np.flatnonzero(self.random.random(len(self.age)) < TICK / 5.0))
        velocity, gyro, up, q = self.sensor("velocity"), self.sensor("gyro"), self.sensor("up"), self.qpos[:, 7:]
        force = np.concatenate([self.sensor(f"{foot} force") for foot in FEET], 1)
        slide = np.sum(np.stack([self.sensor(foot) for foot in FEET], 1)[..., :2] ** 2, 2)
        lift, down = np.sin(2 * np.pi * (self.clock[:, None] + OFFSET)), force > 0
        high = np.minimum(self.sites - 0.06 * lift, 0) ** 2 + np.maximum(self.sites - 0.075, 0) ** 2
        swing, share = np.exp(-force / 10 - high / 0.035**2), np.clip(0.5 + lift, 0, 1)
        stance = (down | self.down) * np.exp(-slide / 0.05)
        over = np.maximum(self.ends[0] - q, 0) + np.maximum(q - self.ends[1], 0)
        reward = (
            np.exp(-np.sum((velocity[:, :2] - self.command[:, :2]) ** 2, 1) / 0.25)
            + 0.5 * np.exp(-((gyro[:, 2] - self.command[:, 2]) ** 2) / 0.25)
            + 2.0 * (share * swing + (1 - share) * stance).mean(1)
            + 0.5 * np.exp(-np.sum((q - STAND) ** 2 * ((1.0, 1.0, 0.1) * 4), 1))
            - 5.0 * np.sum(up[:, :2] ** 2, 1)
            - 0.5 * self.qvel[:, 2] ** 2
            - 0.05 * np.sum(gyro[:, :2] ** 2, 1)
            - np.sum(over, 1)
            - 0.01 * np.sum((action - self.action) ** 2, 1)
            - np.sum((down & ~self.down) * np.sum(landing**2, 2), 1)
        )
        self.clock, self.action, self.down = (self.clock + CLOCK * TICK) % 1.0, action, down
        return np.maximum(reward, 0.0).astype(np.float32), up[:, 2] < 0


def network(key: jax.Array, out: int) -> list[tuple[jax.Array, jax.Array]]:
    sizes = (OBSERVED, 128, 128, out)
    keys, scales = jax.random.split(key, 3), (1.0, 1.0, 0.01 if out > 1 else 1.0)
    return [
        (scale * jax.random.normal(k, (m, n)) / np.sqrt(m), jnp.zeros(n))
        for k, m, n, scale in zip(keys, sizes, sizes[1:], scales, strict=False)
    ]


def apply(layers: Any, x: jax.Array) -> jax.Array:
    for weight, bias in layers[:-1]:
        x = jax.nn.elu(x @ weight + bias)
    return x @ layers[-1][0] + layers[-1][1]


@jax.jit
def act(net: Any, scale: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    x = (x - scale[0]) / scale[1]
    return apply(net["actor"], x), apply(net["critic"], x)[:, 0]


def logarithm(z: jax.Array, spread: jax.Array) -> jax.Array:
    return -0.5 * jnp.sum(z * z, -1) - jnp.sum(spread)


def loss(net: Any, scale: Any, x: Any, action: Any, before: Any, advantage: Any, aim: Any) -> jax.Array:
    mean, value = act(net, scale, x)
    ratio = jnp.exp(logarithm((action - mean) / jnp.exp(net["spread"]), net["spread"]) - before)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    return -gain.mean() + 0.5 * jnp.mean((value - aim) ** 2) - ENTROPY * net["spread"].sum()


@functools.partial(jax.jit, static_argnames="optimizer")
def learn(optimizer: Any, net: Any, state: Any, scale: Any, data: Any, order: jax.Array) -> Any:
    def part(carry: Any, ids: jax.Array) -> Any:
        net, state = carry
        slope = jax.grad(loss)(net, scale, *(each[ids] for each in data))
        change, state = optimizer.update(slope, state)
        return (optax.apply_updates(net, change), state), None

    return jax.lax.scan(part, (net, state), order)[0]


def judge(model: mujoco.MjModel, net: Any, scale: Any) -> dict[str, float]:
    worlds = Worlds(model, 100, 12345, (1.0, 0.0, 0.0))
    fallen, way = np.zeros(100, bool), np.zeros(100)
    for tick in range(500):
        fallen |= worlds.step(np.asarray(act(net, scale, worlds.observe())[0]))[1]
        way += worlds.sensor("velocity")[:, 0] * (tick >= 50)
    return {"success": float(np.mean(~fallen & (way / 450 > 0.8))), "speed": float(np.mean(way / 450))}


def train(path: str, seed: int, seconds: float) -> list[dict[str, float]]:
    began, judged, points = time.perf_counter(), 0.0, []
    model, key = go1(path), jax.random.key(seed)
    worlds = Worlds(model, WORLDS, seed)
    first, second = jax.random.split(key)
    net = {"actor": network(first, ACTED), "critic": network(second, 1), "spread": jnp.full(ACTED, jnp.log(0.5))}
    rate = optax.linear_schedule(1e-3, 5e-4, 400 * EPOCHS * PARTS)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    state, scale = optimizer.init(net), (np.zeros(OBSERVED, np.float32), np.ones(OBSERVED, np.float32))
    seen, x, update = np.zeros((3, OBSERVED)), worlds.observe(), 0
    while (now := time.perf_counter() - began - judged) < seconds:
        if now >= 15.0 * len(points):
            points.append({"seed": seed, "seconds": now, "steps": update * WORLDS * TICKS, **judge(model, net, scale)})
            judged = time.perf_counter() - began - now
            print(json.dumps(points[-1]), flush=True)
        rows, spread = [], np.exp(np.asarray(net["spread"]))
        for _ in range(TICKS):
            mean, value = map(np.asarray, act(net, scale, x))
            noise = worlds.random.standard_normal(mean.shape, np.float32)
            action = mean + spread * noise
            before = np.asarray(logarithm(noise, net["spread"]))
            reward, fell = worlds.step(action)
            over = fell | (worlds.age >= 500)
            after = worlds.observe()
            late = over & ~fell
            reward[late] += GAMMA * np.asarray(act(net, scale, after)[1])[late]
            rows.append((x, action, before, value, reward, over))
            if over.any():
                worlds.reset(np.flatnonzero(over))
                after = worlds.observe()
            x = after
        xs, actions, before, values, rewards, over = (np.stack(each) for each in zip(*rows, strict=True))
        following, carry, advantage = np.asarray(act(net, scale, x)[1]), 0.0, np.empty_like(values)
        for t in reversed(range(TICKS)):
            carry = rewards[t] + GAMMA * ~over[t] * following - values[t] + GAMMA * LAMBDA * ~over[t] * carry
            advantage[t], following = carry, values[t]
        good = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        order = np.stack([worlds.random.permutation(WORLDS * TICKS) for _ in range(EPOCHS)]).reshape(EPOCHS * PARTS, -1)
        data = [
            each.reshape(WORLDS * TICKS, *each.shape[2:]) for each in (xs, actions, before, good, advantage + values)
        ]
        net, state = learn(optimizer, net, state, scale, data, order)
        seen += np.stack([np.full(OBSERVED, data[0].shape[0]), data[0].sum(0), (data[0] ** 2).sum(0)])
        mean = seen[1] / seen[0]
        scale = tuple(np.float32(each) for each in (mean, np.sqrt(np.maximum(seen[2] / seen[0] - mean**2, 0)) + 1e-3))
        update += 1
    return points


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    lines = [point for seed in given.seeds for point in train(given.model, seed, given.seconds)]
    given.out.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
