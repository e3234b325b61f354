"""Which instructions a planner node executes for one request of a mission, found without flying.

A request has no native function round it: it is a row of calls of compiled functions from Python,
with a search among them or without. So its window is a whole run: from where the node begins the
request until it would answer. The node works through the orders before; then a fork of it is
stepped, or many, each for a part of the request, and each ends instead of answering.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.isolated.profile import TargetProfile, profile_run
from mavfi_cli.fi.native import linux
from mavfi_cli.fi.native.fault import Stage
from mavfi_cli.fi.native.image import Image, Scope, scope_of
from mavfi_cli.fi.native.profile import WindowTooLong
from mavfi_cli.fi.native.tracee import Tracee
from mavfi_cli.fi.native.tracer import TracerThread
from mavfi_cli.mission.companion.node_process import NodeProcess
from mavfi_cli.mission.instruction.server import Setup
from mavfi_cli.mission.instruction.spawned_node import SpawnedNode

WHOLE_LIMIT = 600_000  # instructions of a request without a search, or of one window
WINDOWS, ENOUGH = 4, 50_000  # of a request with a search: see `profile_run`


class Rehearsal:
    """The `Place` where one request of a planner node runs, again and again.

    Args:
        setup: of the node.
        orders: input and start stamp of the requests up to that one.
    """

    kind = "node"

    def __init__(self, setup: Setup, orders: Sequence[tuple[object, float]]) -> None:
        self._setup = setup
        self._last = orders[-1]
        self._spawned = SpawnedNode()
        with contextlib.ExitStack() as undo:
            undo.callback(self.close)
            self.scope_of_node = self._spawned.begin(setup)
            self._process = NodeProcess(self._spawned.connection, self._spawned.pid)
            for value, start_s in orders[:-1]:
                self._process.take(self._process.order(setup.node, value, start_s))
            self._image = Image(self._spawned.pid, self.scope_of_node.regions)
            undo.pop_all()

    @property
    def name(self) -> str:
        """Of the kernel."""
        return self.scope_of_node.kernel

    @property
    def pid(self) -> int:
        """Of the node, which is never traced itself."""
        return self._spawned.pid

    def start(self) -> Tracee:
        """A fork of the node, stopped where it begins the request."""
        tracee = Tracee.attach(self._process.rehearse())
        self._process.order(self._setup.node, *self._last)
        if not tracee.run_to(self._image.address(self.scope_of_node.entry)):
            raise TargetError(f"node {self._setup.node}", "does not begin its request again")
        return tracee

    def image(self, _: Tracee) -> Image:
        """What the node has in its memory, and each of its forks."""
        return self._image

    def scope(self, image: Image) -> Scope:
        """The code that may be hit."""
        return scope_of(image, self.scope_of_node.objects)

    def close(self) -> None:
        """End the node."""
        self._spawned.kill()


def profile_request(
    setup: Setup, orders: Sequence[tuple[object, float]], entries: int, rng: np.random.Generator
) -> TargetProfile:
    """Profile what a planner node executes for the last of the orders.

    A request that is answered without a search is stepped whole; one with a search by sample.

    Args:
        setup: of the node.
        orders: input and start stamp, up to the request.
        entries: which entry of the node's scope the request begins with, from 1.
        rng: draws the windows.

    Raises:
        TracingForbidden: the operating system refuses.
        TargetError: nothing in scope executes.
    """
    place = Rehearsal(setup, orders)
    try:
        found = TracerThread(lambda _armed: _profile(place, rng)).result()
    finally:
        place.close()
    begin = Stage(place.scope_of_node.entry, entries)
    return replace(
        found,
        strata=tuple(
            replace(stratum, profile=replace(
                stratum.profile,
                segments=tuple(
                    replace(segment, start=(begin, *segment.start))
                    for segment in stratum.profile.segments
                ),
            ))
            for stratum in found.strata
        ),
    )  # fmt: skip


def _profile(place: Rehearsal, rng: np.random.Generator) -> TargetProfile:
    """On the node's own processor: handing over between two would cost as much again."""
    linux.share_processor(place.pid)
    if not _searches(place):
        try:
            return profile_run(place, rng, limit=WHOLE_LIMIT)
        except WindowTooLong:  # smoothing tries again and again
            pass
    return profile_run(
        place,
        rng,
        markers=place.scope_of_node.inner,
        windows=WINDOWS,
        enough=ENOUGH,
        limit=WHOLE_LIMIT,
    )


def _searches(place: Rehearsal) -> bool:
    tracee = place.start()
    try:
        search = place.scope_of_node.inner[0]
        return tracee.count_to_end(place.image(tracee).address(search)) > 0
    finally:
        tracee.kill()
