"""A controller that walks in the experiments in place of the published one, upon which it acts: a policy."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from nermo_mjx.control.loading import controller_digest, load_controller
from nermo_mjx.control.protocol import ActsUpon
from nermo_mjx.robot import ParameterError


@dataclasses.dataclass(frozen=True)
class Substitute:
    """A controller in place of the published one; the cases set that one's parameters.

    Attributes:
        acts: the controller.
        name: of its file, and the hash of its content, as in the settings of a run.
        content: of its file.
    """

    acts: ActsUpon
    name: str
    content: bytes

    @classmethod
    def of(cls, where: str) -> Substitute:
        """The controller that a text names.

        Raises:
            ParameterError: there is none, or it does not act upon the published controller.
        """
        acts = load_controller(where)
        if not isinstance(acts, ActsUpon):
            raise ParameterError(
                f"controller is {where!r}, which has parameters of its own: allowed is a policy FILE.npz, since the "
                "cases of an experiment set those of the published controller."
            )
        return cls(acts, f"{Path(where).name} {controller_digest(where)}", Path(where).read_bytes())

    @property
    def file(self) -> str:
        """Name of its copy in a directory of experiments, another for each content."""
        name, digest = self.name.rsplit(" ", 1)
        return f"{Path(name).stem}-{digest[:8]}{Path(name).suffix}"

    @property
    def needs_path(self) -> bool:
        """Whether it cannot walk without a path."""
        try:
            self.acts.upon(pilot="open_loop")
        except ParameterError:
            return True
        return False
