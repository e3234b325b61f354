"""Nodes are forks of one program: each begins with the same memory and ends with its mission."""

import os
import pickle
import select
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mavfi_cli.autonomy import tracking
from mavfi_cli.companion.node_process import NodeLost
from mavfi_cli.core.errors import TargetError
from mavfi_cli.mission.briefing import of_config
from mavfi_cli.mission.instruction.forked_node import ForkedNode, load_program
from mavfi_cli.mission.instruction.server import Setup

STARTS_A_NODE = """
import pickle, sys, time
from mavfi_cli.mission.instruction.forked_node import ForkedNode
node = ForkedNode(pickle.load(sys.stdin.buffer), "node")
print(node.pid, flush=True)
time.sleep(60.0)
"""


@pytest.fixture
def setup(short_config):
    briefing = of_config(replace(short_config, goal=(20.0, 0.0, 5.0)), np.zeros(3))
    return Setup(config=short_config, briefing=briefing, node="control")


@pytest.fixture
def fork(setup):
    """Forks a node; all are ended after the test."""
    nodes = []

    def forked(asked=setup):
        nodes.append(ForkedNode(asked, "node control"))
        return nodes[-1]

    yield forked
    for node in nodes:
        node.kill()


def memory_of(node):
    """Addresses and sizes of everything that is mapped, without the files' own numbers."""
    lines = Path(f"/proc/{node.pid}/maps").read_text().splitlines()
    return [line.split()[0] for line in lines]


def test_every_node_begins_with_the_same_memory_whoever_lives_beside_it(fork):
    first = fork()
    found = [memory_of(node) for node in (first, fork(), fork())]
    assert found[0] == found[1] == found[2]
    assert first.scope.kernel == "control"


def test_the_memory_depends_on_the_values_of_a_setup_not_on_its_objects(fork, setup):
    again = pickle.loads(pickle.dumps(setup))  # whose strings are other objects
    alike = replace(setup, node="".join(setup.node))
    assert memory_of(fork()) == memory_of(fork(again)) == memory_of(fork(alike))


@pytest.mark.parametrize(
    ("number", "how"), [(signal.SIGSEGV, "killed by SIGSEGV"), (None, "ended with code 1")]
)
def test_the_end_of_a_node_is_told_in_words(fork, number, how):
    node = fork()
    process = node.process()
    if number is not None:
        os.kill(node.pid, number)
    else:
        node.connection.sendall((4).to_bytes(8, "little") + b"none")  # no message at all
    with pytest.raises(NodeLost, match=how):
        process.take(1)


def test_a_node_that_cannot_be_set_up_says_why(fork, setup):
    with pytest.raises(TargetError, match=r"control: does not start: .* 'nothing'"):
        fork(replace(setup, node="nothing"))


def test_a_node_ends_with_its_mission(setup):
    mission = subprocess.Popen(
        [sys.executable, "-c", STARTS_A_NODE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    mission.stdin.write(pickle.dumps(setup))
    mission.stdin.close()
    node = os.pidfd_open(int(mission.stdout.readline()))
    os.kill(mission.pid, signal.SIGKILL)
    mission.wait()
    assert select.select([node], [], [], 10.0)[0]
    os.close(node)
    mission.stdout.close()


def test_a_program_whose_node_has_filled_a_cache_is_started_again(fork):
    """A node that compiles a module has another memory than one that finds bytecode."""
    restarted = []
    for compiles in (True, False, False, False):
        program = load_program()
        if compiles:
            cache = Path(tracking.__spec__.cached).parent
            (cache / "added").touch()
            (cache / "added").unlink()
        assert fork().scope.kernel == "control"
        restarted.append(load_program() is not program)
    assert restarted[0]
    assert not all(restarted)  # tests that run beside this one may fill caches too
