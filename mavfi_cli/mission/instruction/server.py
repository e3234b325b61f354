"""A node as a separate program: the only attacked process of a mission."""

from __future__ import annotations

import json
import socket
from dataclasses import dataclass, replace

from mavfi_cli.attack.kernels.scope import node_scope
from mavfi_cli.attack.served import CHANNEL, newest_cache_ns
from mavfi_cli.autonomy.warm import warm_up
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.node_process import NodeProcess
from mavfi_cli.companion.pipeline import Companion, CompanionParts
from mavfi_cli.companion.protection import NoProtection
from mavfi_cli.core.config import structure
from mavfi_cli.core.processes import receive, send
from mavfi_cli.core.types import Briefing
from mavfi_cli.core.wall import WallClock
from mavfi_cli.spec.mission import MissionConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """The first message to the program of a node, which replies with the node's `KernelScope`.

    The memory of the node depends on the bytes of the message. So the message holds the golden
    mission, because all missions of a pair share it. It holds the mission as text, because a pickle
    also encodes which objects are identical. A replay builds the same text from the mission's
    record.

    Attributes:
        golden: the mission without fault and protection, as JSON.
    """

    golden: str
    briefing: Briefing
    node: str

    @classmethod
    def of(cls, config: MissionConfig, briefing: Briefing, node: str) -> Setup:
        """Build the message for a node of a mission with or without a fault."""
        own_m = config.loaded_stack().goal_tolerance_m
        recorded = json.dumps(replace(config.golden, goal_tolerance_m=own_m).to_dict())
        golden = structure(json.loads(recorded), MissionConfig).to_dict()
        return cls(golden=json.dumps(golden, sort_keys=True), briefing=briefing, node=node)

    @property
    def config(self) -> MissionConfig:
        """The configuration of the golden mission."""
        return structure(json.loads(self.golden), MissionConfig)


def main() -> None:
    """Load all kernels, receive the node's setup, and serve it until the connection closes."""
    connection = socket.socket(fileno=CHANNEL)
    warm_up()
    try:
        setup: Setup = receive(connection)
    except (OSError, EOFError):
        return
    config = setup.config
    companion = Companion(
        config,
        CompanionParts.of(config),
        setup.briefing,
        WallClock(),
        NoInjection(),
        NoProtection(),
    )
    send(connection, (node_scope(setup.node, config.planner), newest_cache_ns()))
    NodeProcess.serve(connection, companion.executor.process_of(setup.node))


if __name__ == "__main__":
    main()
