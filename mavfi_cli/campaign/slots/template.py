"""The template process: imports and warms everything once, then forks slots.

    python -m mavfi_cli.campaign.slots.template FD MODULE

FD is a socket to the runner; each packet on it carries the descriptor of a new slot's channel.
A mission is a fork of a slot, which is a fork of this process before any mission: a fresh process
each, without the second that the imports take.
"""

from __future__ import annotations

import gc
import importlib
import os
import signal
import socket
import sys
from typing import NoReturn, cast

from mavfi_cli.campaign.slots.slot import Task, serve
from mavfi_cli.core.processes import TEMPLATE, call_this_process, threads

READY = b"ready"


def main() -> NoReturn:
    """Serve until the runner closes its end."""
    call_this_process(TEMPLATE)
    control = socket.socket(fileno=int(sys.argv[1]))
    task = cast(Task, importlib.import_module(sys.argv[2]))
    task.prepare()
    gc.collect()
    if (count := threads()) > 1:
        sys.exit(f"error: {count} threads where one is needed: a fork would lack the others")
    gc.freeze()  # the collector would touch, and so copy, every page that forks share
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # slots reap themselves
    control.send(READY)
    while True:
        packet, channels, _, _ = socket.recv_fds(control, 16, 1)
        if not packet:
            os._exit(0)  # an orderly end would have native libraries complain of what is loaded
        if os.fork() == 0:
            control.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            serve(socket.socket(fileno=channels[0]), task)
        os.close(channels[0])


if __name__ == "__main__":
    main()
