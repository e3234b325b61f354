"""The missions of one order as a flight knows them."""

from __future__ import annotations

from pathlib import Path

from mavfi_cli.campaign.missions import config_from
from mavfi_cli.campaign.slots.desk import Desk
from mavfi_cli.mission.branching import Branching, Member


class Cast(Branching):
    """Branching of missions that a slot was given together.

    Raises:
        ConfigError: a mission that this version of mavfi does not have.
    """

    def __init__(self, desk: Desk) -> None:
        super().__init__(
            [
                Member(config=config_from(mission["changes"]), out=desk.out(number))
                for number, mission in enumerate(desk.missions)
            ]
        )
        self._desk = desk
        if self.me is None:
            desk.begin()
        else:
            desk.become(self.me)

    def become(self, member: int) -> None:
        """Be this mission from now on."""
        self.me = member
        self._desk.become(member)

    def fork(self, member: int) -> bool:
        """Fork: True in the new process, which is the mission; False here."""
        if not self._desk.fork(member):
            return False
        self.me = member
        return True

    def await_fork(self) -> None:
        """Pause until the newest fork has ended."""
        self._desk.await_fork()

    def scratch(self, member: int) -> Path:
        """A new folder for what a mission need not keep."""
        return self._desk.scratch(member)
