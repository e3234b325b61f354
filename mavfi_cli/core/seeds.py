"""Derives named random streams from one root seed, so that golden and faulty runs stay paired.

A stream is identified by its name, not by its order of use. A new consumer of random numbers
therefore never changes the numbers that others draw. A hash of the name is the spawn key of numpy's
SeedSequence.
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

    def generator(self, root_seed: int, *detail: str | int) -> np.random.Generator:
        """Return a new PCG64 random generator for this stream of the root seed.

        Args:
            detail: Names a sub-stream, for example by kernel and invocation.
        """
        return np.random.Generator(np.random.PCG64(self._sequence(root_seed, *detail)))

    def seed(self, root_seed: int, *detail: str | int) -> int:
        """Return a positive 31-bit seed for this stream of the root seed.

        It is meant for consumers that need an integer, such as OMPL or a child process.

        Args:
            detail: Names a sub-stream, for example by kernel and invocation.
        """
        state = self._sequence(root_seed, *detail).generate_state(1, np.uint32)
        return int(state[0] & 0x7FFF_FFFF) or 1

    def _sequence(self, root_seed: int, *detail: str | int) -> np.random.SeedSequence:
        name = "/".join([self.value, *(str(part) for part in detail)])
        digest = hashlib.sha256(name.encode()).digest()
        key = tuple(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
        return np.random.SeedSequence(root_seed, spawn_key=key)
