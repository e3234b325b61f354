"""Real missions on a machine that has no process left for the first fork of a shared flight."""

import errno
import os

import __main__ as fork_server
from mavfi_cli.campaigns import task

prepare = task.prepare


def perform(order, out, **options):
    fork, tries = fork_server.fork, []

    def fork_later(work):
        tries.append(work)
        if len(tries) == 1:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return fork(work)

    fork_server.fork = fork_later
    return task.perform(order, out, **options)
