"""The program whose forks are the attacked nodes of missions."""

from __future__ import annotations

import functools
import pickle
import socket
import time
from dataclasses import dataclass

from mavfi_cli.attack.kernels.scope import node_scope
from mavfi_cli.attack.served import channel, newest_cache_ns
from mavfi_cli.autonomy import planners
from mavfi_cli.autonomy.warm import warm_up
from mavfi_cli.companion.injection import NoInjection
from mavfi_cli.companion.node_process import serve
from mavfi_cli.companion.pipeline import Companion
from mavfi_cli.companion.protection import NoProtection
from mavfi_cli.core.processes import receive, send
from mavfi_cli.core.types import Briefing
from mavfi_cli.core.wall import WallClock
from mavfi_cli.mission.instruction.forked_node import fork_nodes
from mavfi_cli.spec.mission import MissionConfig
from mavfi_cli.spec.platform import load_platform

_FILE_CLOCK = 5  # CLOCK_REALTIME_COARSE, which stamps files


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """The message to a node, which answers with its `KernelScope`."""

    config: MissionConfig
    briefing: Briefing
    node: str


def main() -> None:
    """Load every kernel, and fork nodes until all users have closed their connections."""
    control = channel()
    warm_up()
    try:
        receive(control)
    except (OSError, EOFError):
        return
    send(control, (None, newest_cache_ns()))
    fork_nodes(control, functools.partial(_work, time.clock_gettime_ns(_FILE_CLOCK)))


def _work(ready_ns: int, connection: socket.socket) -> None:
    """Receive a node's setup, and work until the connection closes.

    The answer is the node's scope, and whether bytecode has been written since `ready_ns`.
    """
    setup: Setup = pickle.loads(receive(connection))
    config = setup.config
    companion = Companion(
        config,
        config.loaded_stack(),
        load_platform(config.platform),
        planners.find(config.planner),
        setup.briefing,
        WallClock(),
        NoInjection(),
        NoProtection(),
    )
    scope = node_scope(setup.node, config.planner)
    send(connection, (scope, newest_cache_ns() >= ready_ns))
    serve(connection, companion.executor.process_of(setup.node))


if __name__ == "__main__":
    main()
