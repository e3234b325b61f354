"""Profiles the instructions that a target executes in one run: all of them, or a sample of them.

A run that is not too long is stepped completely. A longer one is cut into windows that together
make up the whole run. Each execution of a *marker*, such as a function's entry, begins a window.
The window ends before the next execution of any marker, or with the run. The code before the first
marker is a window too. The windows of one marker are a stratum. Windows of each stratum are drawn
with equal probability and stepped, so all executed instructions of a stratum are equally likely to
be in the sample.

A few windows, the *pilot*, are stepped first. Their lengths determine how many of the other windows
are stepped: as many as fit into `ENOUGH` instructions, but at least a given number. A sample whose
size depends on its own lengths would be biased, so the pilot is a complete stratum of its own. The
other stepped windows represent the rest, and are equally spaced from a random start.

To draw a fault, a stratum is drawn with a probability proportional to its number of windows times
their mean length. An instruction is then drawn uniformly from the stepped windows of the stratum.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mavfi_cli.attack.callgrind import UNNAMED, Executions
from mavfi_cli.attack.place import AttackPlace, Watch
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.tracer import linux
from mavfi_cli.fi.tracer.counted import CountedRun, CountedStop, Counting, Detour
from mavfi_cli.fi.tracer.fault import InstructionFault, Strategy
from mavfi_cli.fi.tracer.image import Image, Location, Scope, short_name
from mavfi_cli.fi.tracer.record_fields import FaultRecord
from mavfi_cli.fi.tracer.sampling import Segment, Stratum, draw_fault, record_window
from mavfi_cli.fi.tracer.tracee import Tracee
from mavfi_cli.stats.shares import Interval, estimated_total

STEPS = 2_000_000  # limit of one window, instructions
ENOUGH = 200_000  # stepped instructions of all windows of one marker
_NOTHING = "executes no code in scope"
_UNNAMED = (
    "executes code that callgrind cannot name: its file has no writable data, and its address is "
    "not fixed; link it at a fixed address (-no-pie), or name a function"
)
_COOL = 64  # minimum ratio of the hottest instruction's executions to those of the counted one
_CHECKED = 4  # instructions whose counts are checked, in addition to the most executed one
_TAIL = 16  # bytes after the code, for the decoder
_DETOUR_CODE = 32  # bytes of code in which a detour fits, if any fits
Guard = Callable[[Tracee], AbstractContextManager[object]]
_FIRST = np.array([1])
Window = tuple[int, int]  # stratum and number of the sampled window that a run hit


@dataclass(frozen=True, slots=True, kw_only=True)
class _ScopeCode:
    """One contiguous piece of code in scope."""

    start: int  # address
    data: bytes  # the code, and _TAIL bytes after it
    object: str
    offset: int  # of the start in the object


@dataclass(frozen=True, kw_only=True)
class TargetProfile:
    """The instructions in scope that one run executes, from which faults are drawn."""

    strata: tuple[Stratum, ...] = ()
    counted: CountedRun | None = None  # a whole run that was counted instead of stepped
    code: tuple[_ScopeCode, ...]
    cost_s: float
    image: Image | None = None  # None in a profile that was read from a file

    @property
    def complete(self) -> bool:
        """True if every window of the run was stepped."""
        return all(stratum.complete for stratum in self.strata)

    @property
    def windows(self) -> str:
        """The number of stepped windows, such as "4 of 12"."""
        stepped = sum(len(stratum.segments) for stratum in self.strata)
        return f"{stepped} of {sum(stratum.windows_in_run for stratum in self.strata)}"

    @property
    def executed(self) -> int:
        """Number of executed instructions in scope in the stepped windows or the counted run."""
        stepped = sum(stratum.executed for stratum in self.strata)
        return stepped if self.counted is None else self.counted.executed

    @property
    def instructions(self) -> Interval:
        """Number of executed instructions in scope, with a confidence interval.

        It is estimated if the profile is not complete.
        """
        if self.counted is not None:
            return estimated_total([([self.counted.executed], 1)])
        return estimated_total(
            [
                ([len(segment.trace) for segment in stratum.segments], stratum.windows_in_run)
                for stratum in self.strata
            ]
        )

    @property
    def not_reached(self) -> float:
        """Share of executed instructions that are never drawn, because no stop can reach them."""
        return 0.0 if self.counted is None else self.counted.not_reached

    def code_at(self, address: int) -> bytes:
        """Return 16 bytes of code at an address, or fewer at the end of the code."""
        return _code_of(self.code, address)

    def contains(self, addresses: NDArray[np.int64]) -> bool:
        """Return True if all `addresses`, an array of shape (n,), are in scope."""
        inside = np.zeros(len(addresses), bool)
        for piece in self.code:
            behind = addresses - piece.start
            inside |= (behind >= 0) & (behind < len(piece.data) - _TAIL)
        return bool(inside.all())

    def locate(self, address: int) -> Location:
        """Return the location of an address in scope.

        Raises:
            ValueError: the address is not in scope.
        """
        for piece in self.code:
            if 0 <= (at := address - piece.start) < len(piece.data) - _TAIL:
                return Location(piece.object, piece.offset + at)
        raise ValueError(f"{address:#x} is not in scope")

    def window_of(self, record: FaultRecord) -> Window | None:
        """Return the sampled window that contains the fault of a record.

        Returns None if the fault was not drawn from a sample of windows.
        """
        first = record["trigger"][0]
        return self._sampled_windows.get((first["object"], first["offset"], first["count"]))

    @functools.cached_property
    def _sampled_windows(self) -> dict[tuple[str, int, int], Window]:
        return {
            (start.location.object, start.location.offset, start.count): (number, start.count)
            for number in self.sampled
            for segment in self.strata[number].segments
            for start in segment.start[:1]
        }

    @property
    def sampled(self) -> dict[int, int]:
        """Number of stepped windows of each incomplete stratum, keyed by the stratum's number."""
        return {
            number: len(stratum.segments)
            for number, stratum in enumerate(self.strata)
            if not stratum.complete
        }

    def draw(self, plan: Strategy, rng: np.random.Generator) -> InstructionFault:
        """Draw one fault uniformly from the executed instructions, by the strategy `plan`."""
        drawn = self.counted or self._drawn_stratum(rng)
        return draw_fault(drawn, plan, rng, code_at=self.code_at, locate=self.locate)

    def _drawn_stratum(self, rng: np.random.Generator) -> Stratum:
        shares = np.array([stratum.instructions for stratum in self.strata])
        which = int(rng.choice(len(shares), p=shares / shares.sum())) if len(shares) > 1 else 0
        return self.strata[which]

    def after(self, begin: CountedStop) -> TargetProfile:
        """Return the same profile, with triggers that first run to the stop `begin`."""

        def later(stratum: Stratum) -> Stratum:
            segments = (
                replace(segment, start=(begin, *segment.start)) for segment in stratum.segments
            )
            return replace(stratum, segments=tuple(segments))

        return replace(self, strata=tuple(map(later, self.strata)))

    def without(self, methods: Container[Counting]) -> TargetProfile:
        """Return the same profile, with triggers that do not use the counting methods `methods`."""
        strata = self.strata
        if Counting.DETOUR in methods:
            strata = tuple(stratum.without_detours() for stratum in strata)
        return replace(self, strata=strata, counted=self.counted and self.counted.without(methods))

    def describe(self) -> str:
        """Describe the instructions from which faults are drawn, and how they were sampled."""
        if self.complete:
            return f"all {self.executed} executed instructions in scope"
        windows: dict[str, list[int]] = {}
        assert self.image is not None
        for stratum in self.strata:
            if stratum.marker is not None:
                name = short_name(self.image.symbol(stratum.marker) or stratum.marker.object)
                counts = windows.setdefault(name, [0, 0])
                counts[0] += len(stratum.segments)
                counts[1] += stratum.windows_in_run
        parts = [f"{some} of {all_} windows from {name}" for name, (some, all_) in windows.items()]
        if len(windows) < len({stratum.marker for stratum in self.strata}):
            parts.insert(0, "the beginning")
        count = self.instructions
        return (
            f"about {count.value:.3g} executed instructions in scope (95 % interval "
            f"{count.low:.3g} to {count.high:.3g}), by sample: {', '.join(parts)}; "
            f"{self.executed} stepped"
        )


def _code_of(code: Iterable[_ScopeCode], address: int) -> bytes:
    """Return up to 16 bytes of code at `address`; empty if no piece of `code` contains it."""
    for piece in code:
        if 0 <= (at := address - piece.start) < len(piece.data):
            return piece.data[at : at + 16]
    return b""


def profile_run(
    place: AttackPlace,
    rng: np.random.Generator,
    *,
    markers: Sequence[Location] = (),
    end: Location | None = None,
    windows: int = 1,
    enough: int = ENOUGH,
    limit: int = STEPS,
    watch: Watch | None = None,
    guard: Guard = nullcontext,
    reads_own_code: bool = True,
) -> TargetProfile:
    """Profile a golden run by stepping all of it, or a sample of its windows.

    Args:
        markers: instructions in scope, each of which begins a window; empty to step the whole run.
        end: an instruction in scope; its first execution ends the profile.
        windows: minimum number of windows of each marker to step, after a pilot of half as many.
        enough: number of instructions to step per marker. The pilot determines how many windows
            that is.
        guard: creates the context in which a run is stepped.
        reads_own_code: as for `record_window`.

    Raises:
        TargetError: no instruction in scope executes, or the run is not repeatable.
        WindowTooLong: a window has more than `limit` instructions.
    """
    begun = time.perf_counter()
    ends = (*markers, *([end] if end else []))
    first = _Stepper(place, None, ends, limit, watch, guard, reads_own_code=reads_own_code)
    strata = [first.step(_FIRST, 1)]
    for marker, (count, detour) in zip(markers, count_markers(place, markers), strict=True):
        stepper = replace(first, marker=marker, detour=detour)
        pilot, others = np.split(rng.permutation(count) + 1, [max(1, windows // 2)])
        if not len(pilot):
            continue
        known = stepper.step(pilot, len(pilot))
        fit = enough * len(pilot) // max(1, known.executed) - len(pilot)
        strata.append(known)
        if len(others):
            number = min(len(others), max(windows, fit))
            # Evenly spaced from a random start, because windows change in the course of a run.
            places = (rng.random() + np.arange(number)) * len(others) / number
            strata.append(stepper.step(np.sort(others)[places.astype(int)], len(others)))
    strata = [stratum for stratum in strata if stratum.executed]
    if not strata:
        raise TargetError(place.name, _NOTHING)
    return _profile(place, strata, begun)


def profile_call(
    place: AttackPlace, *, limit: int = STEPS, reads_own_code: bool = True
) -> TargetProfile:
    """Profile a function by stepping one call of it. Runs of `place` start at its entry.

    Args:
        reads_own_code: as for `record_window`.

    Raises:
        WindowTooLong: the call executes more than `limit` instructions in scope.
    """
    begun = time.perf_counter()
    stepper = _Stepper(place, None, None, limit, reads_own_code=reads_own_code)
    return _profile(place, [stepper.step(_FIRST, 1)], begun)


def profile_calls(
    place: AttackPlace,
    rng: np.random.Generator,
    functions: Sequence[Location],
    *,
    windows: int,
    limit: int = STEPS,
    watch: Watch | None = None,
    guard: Guard = nullcontext,
    reads_own_code: bool = True,
) -> TargetProfile:
    """Profile one of the functions, drawn in proportion to its calls, by stepping some calls.

    Args:
        windows: largest number of calls to step.
        guard: creates the context in which a run is stepped.
        reads_own_code: as for `record_window`.

    Raises:
        WindowTooLong: a call executes more than `limit` instructions in scope.
        TargetError: none of the functions is ever called.
    """
    begun = time.perf_counter()
    steppers = [
        _Stepper(place, entry, None, limit, watch, guard, reads_own_code=reads_own_code)
        for entry in functions
    ]
    counts = [count for count, _ in count_markers(place, functions)]
    if not any(counts):
        with started(place) as tracee:
            image = place.image(tracee)
        names = " or ".join(short_name(image.symbol(entry)) for entry in functions)
        raise TargetError(place.name, f"never calls {names}")
    which = 0
    if len(functions) > 1:
        drawn = rng.integers(sum(counts))
        which = int(np.searchsorted(np.cumsum(counts), drawn, side="right"))
    number = min(windows, counts[which])
    chosen = rng.choice(counts[which], size=number, replace=False) + 1
    return _profile(place, [steppers[which].step(chosen, sum(counts))], begun)


def profile_counted(
    place: AttackPlace,
    rng: np.random.Generator,
    counts: Executions,
    begun: float,
) -> TargetProfile:
    """Return the profile of a whole run from its execution counts.

    The largest count and a sample of others, drawn in proportion to their size, are checked in
    further runs.

    Args:
        counts: execution counts of the run.
        begun: start of the counting on `time.perf_counter`.

    Raises:
        TargetError: no instruction in scope executes, or a checked count is wrong.
    """
    run, image, code = _counted(place, counts)
    if not run.executed:
        raise TargetError(place.name, _UNNAMED)
    cost_s = time.perf_counter() - begun
    _require_counts(place, run, image, rng)
    return TargetProfile(counted=run, image=image, code=code, cost_s=cost_s)


def native_time_s(place: AttackPlace, counts: Executions) -> float | None:
    """Return the CPU time, in seconds, that a native run needs to reach the given counts.

    Args:
        counts: execution counts of the first part of the run.

    Returns:
        None if nothing in scope has been counted yet, or the native run ends first.
    """
    run, image, _ = _counted(place, counts)
    if not run.executed:
        return None
    # A detour at the hottest instruction would slow the run down.
    cool = np.where(run.reached * _COOL <= run.reached.max(), run.reached, 0)
    index = int(np.argmax(cool if cool.max() >= _COOL else run.reached))
    with started(place) as tracee:
        begun_s = linux.cpu_time_s(tracee.pid)
        for stage in run.stages(index, int(run.reached[index]), image.locate):
            if not tracee.run_to(image.address(stage.location), stage.count, stage.detour):
                return None
        return linux.cpu_time_s(tracee.pid) - begun_s


def _counted(
    place: AttackPlace, counts: Executions
) -> tuple[CountedRun, Image, tuple[_ScopeCode, ...]]:
    """Convert execution counts to the addresses of a native run.

    Returns:
        The counts of instructions in scope, the memory image of the run, and the code in scope.
    """
    image, code, scope = _code(place)
    objects = {entry.path: entry.bias for entry in map(image.named, scope.objects) if entry.path}
    # Valgrind names an object only if the object's writable data is mapped from its file. Other
    # code is either at its linked address, or its address is unknown.
    biases = objects | {UNNAMED: 0}
    executions = {
        biases[path] + offset: count
        for path, executions in counts.items()
        if path in biases
        for offset, count in executions.items()
        if biases[path] + offset in scope
    }
    return CountedRun.of(executions, lambda address: _code_of(code, address)), image, code


def _require_counts(
    place: AttackPlace, run: CountedRun, image: Image, rng: np.random.Generator
) -> None:
    drawn = rng.choice(len(run.counts), size=_CHECKED, p=run.reached / run.executed)
    for index in sorted({int(np.argmax(run.reached)), *drawn.tolist()}):
        if run.reached[index] < run.counts[index]:
            continue
        count, address = int(run.counts[index]), int(run.addresses[index])
        with started(place) as tracee:
            reached = all(
                tracee.run_to(image.address(stage.location), stage.count, stage.detour)
                for stage in run.stages(index, count, image.locate)
            )
            more = reached and tracee.run_to(address, 2)
        if more or not reached:
            raise TargetError(
                place.name,
                f"executes {image.locate(address)} {'more' if more else 'less'} often than "
                f"the {count} times that callgrind counts: its path depends on the processor, on "
                "addresses or on time; name a function or other objects",
            )


def function_of(place: AttackPlace, name: str) -> Location:
    """Return the entry of the function `name`, which must be in scope.

    Raises:
        UnknownName: no function in scope has this name; the message suggests the nearest one.
    """
    with started(place) as tracee:
        image = place.image(tracee)
        return image.function(name, place.scope(image).objects)


def count_markers(
    place: AttackPlace, markers: Sequence[Location]
) -> list[tuple[int, Detour | None]]:
    """Count the executions of markers in a whole run, and find a detour that counts each of them.

    Returns:
        The number of executions of each marker, and its detour; None if no detour fits there.
    """
    if not markers:
        return []
    with started(place) as tracee:
        image, at_once = place.image(tracee), tracee.mechanism.counters
        starts = [image.address(marker) for marker in markers]
        code = {start: tracee.memory.read(start, _DETOUR_CODE) for start in starts}
    wanted: dict[int, int] = {}

    def detour(start: int, executions: Callable[[int], int]) -> Detour | None:
        return Detour.at(start, lambda at: code[start][at - start :][:16], executions)

    for start in starts:  # a first pass notes whose executions decide
        wanted[start] = 0
        detour(start, lambda address: wanted.setdefault(address, 0))
    addresses = sorted(wanted)
    for portion in (addresses[at : at + at_once] for at in range(0, len(addresses), at_once)):
        with started(place) as tracee:
            wanted.update(zip(portion, tracee.count_to_end(*portion), strict=True))
    return [(wanted[start], detour(start, wanted.__getitem__)) for start in starts]


@contextmanager
def started(place: AttackPlace) -> Iterator[Tracee]:
    """Start a run in `place`, and kill it at the end of the context."""
    tracee = place.start()
    try:
        yield tracee
    finally:
        tracee.kill()


def _profile(place: AttackPlace, strata: Iterable[Stratum], begun: float) -> TargetProfile:
    image, code, _ = _code(place)
    cost_s = time.perf_counter() - begun
    return TargetProfile(strata=tuple(strata), image=image, code=code, cost_s=cost_s)


def _code(place: AttackPlace) -> tuple[Image, tuple[_ScopeCode, ...], Scope]:
    with started(place) as tracee:
        image = place.image(tracee)
        scope = place.scope(image)
        places = [image.locate(span.start) for span in scope.spans]
        code = tuple(
            _ScopeCode(
                start=span.start,
                data=tracee.memory.read(span.start, len(span) + _TAIL),
                object=place.object,
                offset=place.offset,
            )
            for span, place in zip(scope.spans, places, strict=True)
        )
    return image, code, scope


@dataclass(frozen=True, slots=True)
class _Stepper:
    """Steps the windows that begin at one marker."""

    place: AttackPlace
    marker: Location | None  # None: the start of the run
    markers: tuple[Location, ...] | None  # where windows end; None: when the function returns
    limit: int
    watch: Watch | None = None
    guard: Guard = nullcontext
    detour: Detour | None = None  # at the marker
    reads_own_code: bool = True

    def step(self, numbers: NDArray[np.int64], count: int) -> Stratum:
        """Step the windows with the given numbers, counted from 1, and return them as a stratum.

        Args:
            numbers: (n,) numbers of the windows to step.
            count: number of all windows that the stratum represents.
        """
        left = sorted(numbers.tolist())
        segments: list[Segment] = []
        while left:  # one pass, unless a function calls itself
            windows = list(self._pass(left))
            segments += windows
            left = left[len(windows) :]
        return Stratum(marker=self.marker, segments=tuple(segments), windows_in_run=count)

    def _pass(self, numbers: Sequence[int]) -> Iterator[Segment]:
        """Step windows of one run and yield each. Stop before one that begins inside another."""
        with started(self.place) as tracee, self.guard(tracee):
            image = self.place.image(tracee)
            address = -1 if self.marker is None else image.address(self.marker)
            passed = 0
            for number in numbers:
                if number <= passed and self.marker is not None:
                    return
                start: tuple[CountedStop, ...] = ()
                if self.marker is not None:
                    start = (CountedStop(self.marker, number, self.detour),)
                    if not tracee.run_to(address, number - passed, self.detour):
                        raise TargetError(
                            self.place.name, "does not make the same function calls in every run"
                        )
                trace = record_window(
                    tracee,
                    self.place.scope(image),
                    limit=self.limit,
                    program=self.place.name,
                    until_return=self.markers is None,
                    markers=[image.address(marker) for marker in self.markers or ()],
                    watch=self.watch,
                    reads_own_code=self.reads_own_code,
                )
                passed = number + int(np.count_nonzero(trace == address)) - 1
                yield Segment(start=start, trace=trace)
