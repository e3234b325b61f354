"""One root seed, separate streams: golden and faulty runs stay paired.

A stream is named, not numbered by order of use, so that adding a consumer never shifts
another's numbers. Uses numpy's SeedSequence with the stream's name as spawn key.
"""

from __future__ import annotations

import hashlib
from enum import Enum

import numpy as np


class Stream(Enum):
    """The independent random streams of a mission."""

    WORLD = "world"
    MISSION = "mission"
    FAULT = "fault"
    PLANNER = "planner"
    LATENCY = "latency"
    SENSOR = "sensor"


def _spawn_key(name: str) -> tuple[int, ...]:
    digest = hashlib.sha256(name.encode()).digest()
    return tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))


def seed_sequence(root_seed: int, stream: Stream, *detail: str | int) -> np.random.SeedSequence:
    """The seed sequence of one stream; `detail` names a sub-stream (kernel, invocation)."""
    name = "/".join([stream.value, *(str(part) for part in detail)])
    return np.random.SeedSequence(root_seed, spawn_key=_spawn_key(name))


def generator(root_seed: int, stream: Stream, *detail: str | int) -> np.random.Generator:
    """A fresh PCG64 generator of one stream."""
    return np.random.Generator(np.random.PCG64(seed_sequence(root_seed, stream, *detail)))


def derive(root_seed: int, stream: Stream, *detail: str | int) -> int:
    """A 31-bit positive seed for a library that takes an int (OMPL, a child process)."""
    state = seed_sequence(root_seed, stream, *detail).generate_state(1, np.uint32)
    return int(state[0] & 0x7FFF_FFFF) or 1
