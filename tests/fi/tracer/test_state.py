"""Stopped forks of one process: what counts as a difference, and what does not."""

import ctypes
import os
import socket
import time

import pytest

from mavfi_cli.attack.tracer_thread import TracerThread
from mavfi_cli.core.processes import fork
from mavfi_cli.fi.tracer.linux import SUPPORTED, share_processor
from mavfi_cli.fi.tracer.state import StoppedFork, remembers_the_same
from mavfi_cli.fi.tracer.tracee import Tracee
from mavfi_cli.mission.machine import OK, check_tracing

pytestmark = pytest.mark.skipif(
    not SUPPORTED or check_tracing().verdict != OK, reason="nothing can be traced here"
)
SENDTO = 44


@pytest.fixture
def process():
    """A process that answers each byte; a byte of its memory decides what it does."""
    ours, theirs = socket.socketpair()
    switch = ctypes.create_string_buffer(1)

    def work():
        ours.close()
        while theirs.recv(1):
            begun_s = time.perf_counter()
            if switch.raw == b"\1":
                os.umask(os.umask(0o022))
            theirs.send(b"!")
            del begun_s
        return 0

    pid = fork(work)
    theirs_fd = theirs.detach()
    os.close(theirs_fd)
    yield pid, ours, theirs_fd, ctypes.addressof(switch)
    ours.close()
    os.waitpid(pid, 0)


def compared(process, change):
    """Whether a fork that `change` has struck in front of its work remembers the same."""
    pid, connection, descriptor, switch = process

    def work(_):
        share_processor(pid)
        node, forks = Tracee.attach(pid, alone=True), []
        node.await_call()
        for struck in (True, False, False):
            forked = node.fork()
            connection.send(b"?")
            if struck:
                change(forked, switch)
            calls = forked.run_to_call(SENDTO, descriptor)
            forks.append(StoppedFork(tracee=forked, calls=calls))
        try:
            return remembers_the_same(forks[0], (forks[1], forks[2]))
        finally:
            for forked in forks:
                forked.tracee.kill()
            node.detach()

    return TracerThread(work).result()


def test_an_unstruck_fork_remembers_the_same_although_it_has_read_the_clock(process):
    assert compared(process, lambda *_: None)


def test_a_byte_of_memory_is_remembered(process):
    assert not compared(process, lambda forked, switch: forked.memory.write(switch, b"\2"))


def test_another_system_call_is_remembered(process):
    """It leaves the process as it was, but it may have changed the operating system."""
    assert not compared(process, lambda forked, switch: forked.memory.write(switch, b"\1"))


def test_what_lies_below_the_stack_pointer_is_forgotten(process):
    def change(forked, _):
        forked.memory.write(forked.registers.sp - 60_000, b"left over")

    assert compared(process, change)


def test_the_process_goes_on_as_if_it_had_not_been_forked(process):
    _, connection, _, _ = process
    assert compared(process, lambda *_: None)
    connection.send(b"?")
    assert connection.recv(1) == b"!"
