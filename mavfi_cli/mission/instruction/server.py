"""A node as a program of its own: the one process of a mission that is attacked.

It is started afresh, without address randomisation and with a fixed environment, and its memory
depends on the orders that it gets only: so a corrupted pointer meets the same things in every
repetition. A fork of the companion would carry the traces of everything that ran there before.
"""

from __future__ import annotations

import os
import socket
import sys
from dataclasses import dataclass

from mavfi_cli.attack.kernels.scope import node_scope
from mavfi_cli.autonomy import planners, warm_up
from mavfi_cli.core.wall import WallClock
from mavfi_cli.mission.briefing import Briefing
from mavfi_cli.mission.companion.companion import Companion
from mavfi_cli.mission.companion.node_process import receive, send, serve
from mavfi_cli.mission.companion.protection import NoProtection
from mavfi_cli.mission.config import MissionConfig, stack_of
from mavfi_cli.mission.injection import NoInjection
from mavfi_cli.mission.platform import load_platform


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """The first message to the program; it answers with its `KernelScope` and a stamp.

    The stamp says when something was last added to a cache of the code that it has loaded, ns since
    the epoch.
    """

    config: MissionConfig
    briefing: Briefing
    node: str


def _newest_cache_ns() -> int:
    """When a file of bytecode, or of compiled kernels beside it, was last added, ns."""
    specs = [getattr(module, "__spec__", None) for module in sys.modules.values()]
    files = [spec.cached for spec in specs if spec is not None and spec.cached is not None]
    folders = sorted({os.path.dirname(file) for file in files})
    return max((os.stat(each).st_mtime_ns for each in folders if os.path.isdir(each)), default=0)


def main() -> None:
    """Load every kernel, hear which node to be, and work until the connection closes."""
    connection = socket.socket(fileno=int(sys.argv[1]))
    warm_up()
    try:
        setup: Setup = receive(connection)
    except (OSError, EOFError):
        return
    config = setup.config
    companion = Companion(
        config,
        stack_of(config),
        load_platform(config.platform),
        planners.find(config.planner),
        setup.briefing,
        WallClock(),
        NoInjection(),
        NoProtection(),
    )
    send(connection, (node_scope(setup.node, config.planner), _newest_cache_ns()))
    serve(connection, companion.executor.process_of(setup.node))


if __name__ == "__main__":
    main()
