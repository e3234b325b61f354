"""What one of our processes sends to another: values, and no calls."""

import os
import pickle
import socket
from dataclasses import dataclass
from threading import Thread

import numpy as np
import pytest

from mavfi_cli.attack.served import ServedProcess
from mavfi_cli.core.processes import receive, send
from mavfi_cli.core.types import Command, Outcome


@pytest.fixture
def pair():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def test_values_arrive_as_they_were(pair):
    command = Command(stamp_s=1.0, velocity_enu_mps=np.array([1.0, np.nan, -0.0]), yaw_rad=0.5)
    value = (command, Outcome.HANG, range(3), np.float64(2.0), {"name": [None, b"x"]})
    send(pair[0], value)
    got = receive(pair[1])
    assert got[1:] == value[1:]
    np.testing.assert_array_equal(got[0].velocity_enu_mps, command.velocity_enu_mps)


def test_a_value_that_arrives_in_pieces_is_received_by_one_call(pair):
    class Counting:
        def recv_into(self, *arguments, **options):
            sizes.append(pair[1].recv_into(*arguments, **options))
            return sizes[-1]

    sizes, value = [], b"x" * 4_000_000  # more than a socket's buffer holds
    sender = Thread(target=send, args=(pair[0], value))
    sender.start()
    assert receive(Counting()) == value
    sender.join()
    assert len(sizes) == 2  # its length and itself


@dataclass
class _Call:
    """Pickles as a call of a function."""

    function: object
    arguments: tuple = ()

    def __reduce__(self):
        return self.function, self.arguments


@pytest.mark.parametrize(
    "call",
    [
        _Call(os.system, ("touch struck",)),
        _Call(eval, ("1",)),
        _Call(getattr, ("", "upper")),
        _Call(ServedProcess, ("antigravity",)),
        _Call(send, (None, None)),
    ],
    ids=["os", "eval", "getattr", "our process", "our function"],
)
def test_a_corrupted_process_cannot_have_its_parent_call_anything(
    pair, call, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    send(pair[0], call)
    with pytest.raises(pickle.UnpicklingError, match="not a message type"):
        receive(pair[1])
    assert not (tmp_path / "struck").exists()
