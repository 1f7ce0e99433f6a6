"""What the viewer's page shows of a drive: its document at the start, then a row of numbers for each moment."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from nermo_mjx.live.driving import Driving
from nermo_mjx.robot import LIMBS
from nermo_mjx.view.clip import clips_of
from nermo_mjx.view.page import Packer, document
from nermo_mjx.view.recorded import ARC, Motion, motion_of, plots_of, recorded_model

#: Arrows for contacts: two for each limb, and others.
SLOTS: Final = (*(limb for limb in range(len(LIMBS)) for _ in range(2)), *(-1,) * 8)
#: Time in which the followed point comes near the robot [s].
FOLLOW: Final = 0.25


class Shown:
    """A drive on the page."""

    def __init__(self, driving: Driving) -> None:
        self.driving = driving
        start = driving.sample
        self._model = recorded_model(start, driving.simulator.robot)
        self._data = mujoco.MjData(self._model)
        self._packer = Packer()
        self._header = clips_of([start], ["drive"], self._packer)
        wraps = self._model.wrap_type
        #: Points of each tendon at most: a site is one, and a pulley two with an arc between them.
        self._points = [
            sum(1 if wraps[k] == mujoco.mjtWrap.mjWRAP_SITE else 2 + ARC for k in range(first, first + count))
            for first, count in zip(self._model.tendon_adr, self._model.tendon_num, strict=True)
        ]
        clip = self._header["clips"][0]
        follow = np.frombuffer(self._packer.content, "<f4", 3, clip["follow"]["at"])
        self._centre = follow - start.qpos[0, :3]
        self.restart()

    def restart(self) -> None:
        """The robot is at its start again."""
        self._follow: np.ndarray | None = None
        self._before: np.ndarray | None = None
        self._speeds: list[tuple[float, float]] = []
        self._time = 0.0

    def document(self, about: dict[str, Any]) -> str:
        """The page; `about` is what its driving part has to know."""
        live = {"points": self._points, "slots": SLOTS, **about}
        return document("viewer", "Nermo: drive", self._header | {"live": live}, [self._packer], ("", "live"))

    def row(self) -> bytes:
        """The present moment, as floats: time, root, followed point; place and rotation of each moving body; of each
        tendon its points and tension; point and force of each slot; and the value of each curve."""
        sample = self.driving.sample
        motion = motion_of(sample, self._model, data=self._data)
        bodies = self._header["clips"][0]["moving"]
        origin = motion.position[0, self._header["clips"][0]["root"]]
        turns = motion.quaternion[0, bodies]
        if self._before is not None:
            turns = np.where((turns * self._before).sum(-1, keepdims=True) < 0, -turns, turns)
        self._before = turns
        wanted, passed = origin + self._centre, self.driving.time - self._time
        self._time = self.driving.time
        held = wanted if self._follow is None else self._follow
        self._follow = held + (wanted - held) * (1.0 - np.exp(-passed / FOLLOW))
        parts = [[self.driving.time], origin, self._follow, motion.position[0, bodies] - origin, turns]
        for tendon, points in zip(motion.tendons, self._points, strict=True):
            path = tendon.path[0][:points] - origin
            parts += [np.pad(path, ((0, points - len(path)), (0, 0)), mode="edge"), tendon.tension]
        parts += [self._contacts(motion, origin), self._curves(sample, motion)]
        return np.concatenate([np.ravel(part) for part in parts]).astype("<f4").tobytes()

    def _contacts(self, motion: Motion, origin: np.ndarray) -> np.ndarray:
        slots, taken = np.zeros((len(SLOTS), 6)), set[int]()
        for contact in motion.contacts:
            free = next((k for k, limb in enumerate(SLOTS) if limb == contact.limb and k not in taken), None)
            if free is not None:
                taken.add(free)
                slots[free] = *(contact.point[0] - origin), *contact.force[0]
        return slots

    def _curves(self, sample: Any, motion: Motion) -> list[float]:
        values = []
        for plot in plots_of(sample, motion):
            for line in plot.lines:
                value = float(line.values[0])
                if plot.key == "speed" and not line.faint:
                    value = self._mean_speed(float(plot.lines[1].values[0]))
                values.append(value)
        return values

    def _mean_speed(self, speed: float) -> float:
        """Over the last gait cycle."""
        begin = self._time - 1.0 / self.driving.cycle_rate
        self._speeds = [each for each in self._speeds if each[0] > begin] + [(self._time, speed)]
        return float(np.mean([each for _, each in self._speeds]))
