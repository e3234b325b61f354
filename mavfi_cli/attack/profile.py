"""Which instructions a target executes in one run: all of them, or a stated sample.

A run that is not too long is stepped completely. Another is cut into windows that together are the
whole run: each execution of a *marker* (a function's first instruction, say) begins one, which ends
in front of the next execution of any marker, or with the run; what comes before the first marker is
a window of its own. The windows of one marker are a stratum. Of each stratum some windows are drawn
uniformly and stepped, so every executed instruction of the scope has the same chance as all others
of its stratum to be in the sample; where windows are short, more are drawn, as many as the first
ones say fit into `ENOUGH` instructions. A stratum is then drawn in proportion to its windows times
their mean length, and an instruction uniformly out of its stepped windows.
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
from mavfi_cli.fi.tracer.fault import InstructionFault, Stage
from mavfi_cli.fi.tracer.image import Image, Location
from mavfi_cli.fi.tracer.sampling import Strategy, draw_fault
from mavfi_cli.fi.tracer.symbols import short_name
from mavfi_cli.fi.tracer.windows import Segment, Stratum, record_window

STEPS = 2_000_000  # of one window
ENOUGH = 200_000  # stepped instructions of one marker's windows
_FIRST = np.array([1])
Watch = Callable[[int], None]  # called with instructions stepped since it was called last


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetProfile:
    """What can be hit in one run, with what is needed to draw from it after the run is gone."""

    strata: tuple[Stratum, ...]
    image: Image
    code: tuple[tuple[int, bytes], ...]  # start address and bytes of the code in scope
    cost_s: float

    @property
    def complete(self) -> bool:
        """Every window of the run was stepped."""
        return all(stratum.complete for stratum in self.strata)

    @property
    def windows(self) -> str:
        """How many windows of how many were stepped."""
        stepped = sum(len(stratum.segments) for stratum in self.strata)
        return f"{stepped} of {sum(stratum.windows_in_run for stratum in self.strata)}"

    @property
    def executed(self) -> int:
        """Executed instructions in scope, over the stepped windows."""
        return sum(stratum.executed for stratum in self.strata)

    @property
    def instructions(self) -> float:
        """Executed in scope; estimated where the profile is not complete."""
        return sum(stratum.instructions for stratum in self.strata)

    def code_at(self, address: int) -> bytes:
        """16 bytes of code."""
        for start, data in self.code:
            if start <= address < start + len(data):
                return data[address - start : address - start + 16]
        return b""

    def window_of(self, record: Mapping[str, Any]) -> Window | None:
        """The sampled window that a fault is from; None where no sample of windows was taken."""
        first = record["trigger"][0]
        for number, stratum in enumerate(self.strata):
            at = stratum.marker
            if at is not None and (at.object, at.offset) == (first["object"], first["offset"]):
                return None if stratum.complete else (number, int(first["count"]))
        return None

    def draw(self, plan: Strategy, rng: np.random.Generator) -> InstructionFault:
        """One fault, uniform over the executed instructions."""
        shares = np.array([stratum.instructions for stratum in self.strata])
        which = int(rng.choice(len(shares), p=shares / shares.sum())) if len(shares) > 1 else 0
        stratum, locate = self.strata[which], self.image.locate
        return draw_fault(stratum, plan, rng, code_at=self.code_at, locate=locate)

    def after(self, begin: Stage) -> TargetProfile:
        """The same windows in a run that has to reach `begin` first."""

        def later(stratum: Stratum) -> Stratum:
            """All its segments after the new stage."""
            segments = (replace(each, start=(begin, *each.start)) for each in stratum.segments)
            return replace(stratum, segments=tuple(segments))

        return replace(self, strata=tuple(map(later, self.strata)))

    def in_words(self) -> str:
        """How the population of faults was found."""
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
    """A watch that has `stage` told how many instructions were stepped so far."""
    total = 0

    def watch(steps: int) -> None:
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
    """Step a fault-free run, or a sample of the windows that markers cut it into.

    Args:
        place: where it runs.
        rng: draws the windows.
        markers: instructions in scope; none for the whole run.
        windows: how many of each marker are stepped at least.
        enough: more of them where together they have no more instructions.
        limit: refuse longer windows, instructions.
        watch: is told how far it is.

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
    """Step one call of a function: the runs of the place start at its entry.

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
    """Step invocations of one function, which is drawn by how often it is called.

    Args:
        place: where the target runs.
        rng: draws the function and its invocations.
        functions: the entries of those that it is drawn from.
        windows: how many invocations are stepped at most.
        limit: refuse longer ones, instructions.
        watch: is told how far it is.

    Raises:
        WindowTooLong: too many instructions.
        TargetError: none of them is ever called.
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
    """The entry of a function in scope.

    Raises:
        UnknownName: there is none of that name; names the nearest.
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
        """How many windows a run has."""
        assert self.marker is not None
        tracee = self.place.start()
        try:
            return tracee.count_to_end(self.place.image(tracee).address(self.marker))
        finally:
            tracee.kill()

    def step(self, numbers: NDArray[np.int64], count: int) -> Stratum:
        """The windows of these numbers, from 1, of `count`."""
        left = sorted(numbers.tolist())
        segments: list[Segment] = []
        while left:  # once, unless a function calls itself
            found = list(self._pass(left))
            segments += found
            left = left[len(found) :]
        return Stratum(marker=self.marker, segments=tuple(segments), windows_in_run=count)

    def _pass(self, numbers: Sequence[int]) -> Iterator[Segment]:
        """Windows of one run, until one lies inside the window before."""
        tracee = self.place.start()
        try:
            image = self.place.image(tracee)
            address = -1 if self.marker is None else image.address(self.marker)
            passed = 0
            for number in numbers:
                if number <= passed and self.marker is not None:
                    return
                start: tuple[Stage, ...] = ()
                if self.marker is not None:
                    start = (Stage(self.marker, number),)
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
