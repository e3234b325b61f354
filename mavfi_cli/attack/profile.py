"""Profiles the instructions that a target executes in one run: all of them, or a stated sample.

A run that is not too long is stepped completely. A longer one is cut into windows that together are
the whole run. Each execution of a *marker*, such as a function's entry, begins a window.
It ends in front of the next execution of any marker, or with the run. The code before the first
marker is a window too. The windows of one marker are a stratum. Some windows of each stratum are
drawn uniformly and stepped, so every executed instruction in scope is as likely to be in the sample
as all others of its stratum. If windows are short, more are drawn: as many as fit into `ENOUGH`
instructions by the length of the first ones. A stratum is then drawn in proportion to its windows
times their mean length, and an instruction uniformly from its stepped windows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.outcome import Window
from mavfi_cli.attack.target import AttackPlace
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer.fault import CountedStop, InstructionFault
from mavfi_cli.fi.tracer.image import Image, Location
from mavfi_cli.fi.tracer.sampling import Strategy, draw_fault
from mavfi_cli.fi.tracer.symbols import short_name
from mavfi_cli.fi.tracer.windows import Segment, Stratum, record_window

STEPS = 2_000_000  # of one window
ENOUGH = 200_000  # stepped instructions of all windows of one marker
_FIRST = np.array([1])
Watch = Callable[[int], None]  # called with the instructions stepped since the last call


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetProfile:
    """The instructions that can be hit in one run, with what is needed to draw from them."""

    strata: tuple[Stratum, ...]
    image: Image
    code: tuple[tuple[int, bytes], ...]  # start address and bytes of the code in scope
    cost_s: float

    @property
    def complete(self) -> bool:
        """True if every window of the run was stepped."""
        return all(stratum.complete for stratum in self.strata)

    @property
    def windows(self) -> str:
        """Stepped windows and all windows, in words."""
        stepped = sum(len(stratum.segments) for stratum in self.strata)
        return f"{stepped} of {sum(stratum.windows_in_run for stratum in self.strata)}"

    @property
    def executed(self) -> int:
        """Number of executed instructions in scope, over the stepped windows."""
        return sum(stratum.executed for stratum in self.strata)

    @property
    def instructions(self) -> float:
        """Number of executed instructions in scope; estimated if the profile is not complete."""
        return sum(stratum.instructions for stratum in self.strata)

    def code_at(self, address: int) -> bytes:
        """16 bytes of code."""
        for start, data in self.code:
            if start <= address < start + len(data):
                return data[address - start : address - start + 16]
        return b""

    def window_of(self, record: Mapping[str, Any]) -> Window | None:
        """The sampled window of a fault; None if no sample of windows was taken."""
        first = record["trigger"][0]
        for number, stratum in enumerate(self.strata):
            at = stratum.marker
            if at is not None and (at.object, at.offset) == (first["object"], first["offset"]):
                return None if stratum.complete else (number, int(first["count"]))
        return None

    def draw(self, plan: Strategy, rng: np.random.Generator) -> InstructionFault:
        """Draw one fault, uniformly over the executed instructions."""
        shares = np.array([stratum.instructions for stratum in self.strata])
        which = int(rng.choice(len(shares), p=shares / shares.sum())) if len(shares) > 1 else 0
        stratum, locate = self.strata[which], self.image.locate
        return draw_fault(stratum, plan, rng, code_at=self.code_at, locate=locate)

    def after(self, begin: CountedStop) -> TargetProfile:
        """Make the same profile for a run that has to reach `begin` first."""

        def later(stratum: Stratum) -> Stratum:
            """The stratum with the new stage before each segment's start."""
            segments = (replace(each, start=(begin, *each.start)) for each in stratum.segments)
            return replace(stratum, segments=tuple(segments))

        return replace(self, strata=tuple(map(later, self.strata)))

    def in_words(self) -> str:
        """How the population of faults was found, in words."""
        if self.complete:
            return f"all {self.instructions:.0f} executed instructions in scope"
        parts = []
        for stratum in self.strata:
            if stratum.marker is None:
                parts.append("the beginning")
                continue
            name = short_name(self.image.symbol(stratum.marker) or stratum.marker.object)
            stepped = f"{len(stratum.segments)} of {stratum.windows_in_run}"
            parts.append(f"{stepped} windows from {name}")
        return (
            f"about {self.instructions:.3g} executed instructions in scope, by sample: "
            f"{', '.join(parts)}; {self.executed} stepped"
        )


def steps_told(stage: Callable[[str], None]) -> Watch:
    """Make a watch that tells `stage` the number of instructions stepped so far."""
    total = 0

    def watch(steps: int) -> None:
        """Add these steps and tell the sum."""
        nonlocal total
        total += steps
        stage(f"profile, {total} instructions stepped")

    return watch


def profile_run(
    place: AttackPlace,
    rng: np.random.Generator,
    *,
    markers: Sequence[Location] = (),
    windows: int = 1,
    enough: int = ENOUGH,
    limit: int = STEPS,
    watch: Watch | None = None,
) -> TargetProfile:
    """Step a golden run, or a sample of the windows that markers cut it into.

    Args:
        place: the place where it runs.
        rng: draws the windows.
        markers: instructions in scope; none for the whole run.
        windows: the least number of windows of each marker to step.
        enough: more windows are stepped while they have at most this many instructions together.
        limit: refuse longer windows, instructions.
        watch: called with the progress.

    Raises:
        TargetError: no instruction in scope executes, or the run does not repeat itself.
        WindowTooLong: too many instructions.
    """
    begun = time.perf_counter()
    first = _Stepper(place, None, tuple(markers), limit, watch)
    strata = [first.step(_FIRST, 1)]
    for marker in markers:
        stepper = _Stepper(place, marker, tuple(markers), limit, watch)
        if count := stepper.count():
            order = rng.permutation(count) + 1
            stratum = stepper.step(order[:windows], count)
            fit = enough * windows // max(1, stratum.executed)
            if windows < min(fit, count):
                stratum = stepper.step(order[:fit], count)
            strata.append(stratum)
    strata = [stratum for stratum in strata if stratum.executed]
    if not strata:
        raise TargetError(place.name, "executes nothing that may be hit")
    return _profile(place, strata, begun)


def profile_call(place: AttackPlace, *, limit: int = STEPS) -> TargetProfile:
    """Step one call of a function, at whose entry the runs of the place start.

    Raises:
        WindowTooLong: too many instructions.
    """
    begun = time.perf_counter()
    return _profile(place, [_Stepper(place, None, None, limit).step(_FIRST, 1)], begun)


def profile_calls(
    place: AttackPlace,
    rng: np.random.Generator,
    functions: Sequence[Location],
    *,
    windows: int,
    limit: int = STEPS,
    watch: Watch | None = None,
) -> TargetProfile:
    """Step calls of one function, which is drawn in proportion to its calls.

    Args:
        place: the place where the target runs.
        rng: draws the function and its calls.
        functions: entries of the functions to draw from.
        windows: the most calls to step.
        limit: refuse longer calls, instructions.
        watch: called with the progress.

    Raises:
        WindowTooLong: too many instructions.
        TargetError: none of the functions is ever called.
    """
    begun = time.perf_counter()
    steppers = [_Stepper(place, entry, None, limit, watch) for entry in functions]
    counts = [stepper.count() for stepper in steppers]
    if not any(counts):
        image = _image(place)
        names = " or ".join(short_name(image.symbol(entry)) for entry in functions)
        raise TargetError(place.name, f"never calls {names}")
    which = 0
    if len(functions) > 1:
        drawn = rng.integers(sum(counts))
        which = int(np.searchsorted(np.cumsum(counts), drawn, side="right"))
    number = min(windows, counts[which])
    chosen = rng.choice(counts[which], size=number, replace=False) + 1
    return _profile(place, [steppers[which].step(chosen, sum(counts))], begun)


def function_of(place: AttackPlace, name: str) -> Location:
    """Find the entry of a function in scope.

    Raises:
        UnknownName: there is no function of that name; names the nearest.
    """
    tracee = place.start()
    try:
        image = place.image(tracee)
        return image.function(name, place.scope(image).objects)
    finally:
        tracee.kill()


def _image(place: AttackPlace) -> Image:
    tracee = place.start()
    try:
        return place.image(tracee)
    finally:
        tracee.kill()


def _profile(place: AttackPlace, strata: Iterable[Stratum], begun: float) -> TargetProfile:
    tracee = place.start()
    try:
        image = place.image(tracee)
        spans = place.scope(image).spans
        code = tuple((s.start, tracee.read_memory(s.start, len(s) + 16)) for s in spans)
    finally:
        tracee.kill()
    return TargetProfile(
        strata=tuple(strata), image=image, code=code, cost_s=time.perf_counter() - begun
    )


@dataclass(frozen=True, slots=True)
class _Stepper:
    """Steps the windows that begin at one marker."""

    place: AttackPlace
    marker: Location | None  # None: the start of the run
    markers: tuple[Location, ...] | None  # where windows end; None: when the function returns
    limit: int
    watch: Watch | None = None

    def count(self) -> int:
        """Count the windows of a run."""
        assert self.marker is not None
        tracee = self.place.start()
        try:
            return tracee.count_to_end(self.place.image(tracee).address(self.marker))
        finally:
            tracee.kill()

    def step(self, numbers: NDArray[np.int64], count: int) -> Stratum:
        """Step the windows of these numbers, from 1, out of `count`."""
        left = sorted(numbers.tolist())
        segments: list[Segment] = []
        while left:  # one pass, unless a function calls itself
            found = list(self._pass(left))
            segments += found
            left = left[len(found) :]
        return Stratum(marker=self.marker, segments=tuple(segments), windows_in_run=count)

    def _pass(self, numbers: Sequence[int]) -> Iterator[Segment]:
        """Step windows of one run, until one lies inside the window before it."""
        tracee = self.place.start()
        try:
            image = self.place.image(tracee)
            address = -1 if self.marker is None else image.address(self.marker)
            passed = 0
            for number in numbers:
                if number <= passed and self.marker is not None:
                    return
                start: tuple[CountedStop, ...] = ()
                if self.marker is not None:
                    start = (CountedStop(self.marker, number),)
                    if not tracee.run_to(address, number - passed):
                        raise TargetError(self.place.name, "does not repeat its function calls")
                trace = record_window(
                    tracee,
                    self.place.scope(image),
                    limit=self.limit,
                    program=self.place.name,
                    until_return=self.markers is None,
                    markers=[image.address(marker) for marker in self.markers or ()],
                    watch=self.watch,
                )
                passed = number + int(np.count_nonzero(trace == address)) - 1
                yield Segment(start=start, trace=trace)
        finally:
            tracee.kill()
