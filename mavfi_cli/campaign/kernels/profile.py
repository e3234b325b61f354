"""Which instructions a kernel executes: all of them, or a stated sample where there are too many.

A kernel that enters its native code once, and not for too long, is stepped completely. Of one that
enters it many times some entries are stepped. Of one that is too long even so, invocations of
functions inside it are: each function is a stratum, drawn in proportion to its share of executed
instructions (executions x mean length). What executes outside of these functions is not hit then.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass

import numpy as np

from mavfi_cli.campaign.kernels.place import Place
from mavfi_cli.core.errors import TargetError
from mavfi_cli.fi.native.fault import InstructionFault, Stage
from mavfi_cli.fi.native.image import Location, scope_of
from mavfi_cli.fi.native.profile import Profile, Segment, record_window
from mavfi_cli.fi.sampling import Strategy, draw_fault

STEPS = 2_000_000  # a window of a minute


@dataclass(frozen=True, slots=True, kw_only=True)
class Stratum:
    """Invocations of one function, and those of them that were stepped."""

    function: Location
    symbol: str
    profile: Profile

    @property
    def instructions(self) -> float:
        """Executed instructions of all invocations, estimated from the stepped ones."""
        profile = self.profile
        return profile.executed / len(profile.segments) * profile.windows_in_run


@dataclass(frozen=True, slots=True, kw_only=True)
class KernelProfile:
    """What can be hit in one run of a kernel."""

    strata: tuple[Stratum, ...]
    code: tuple[tuple[int, bytes], ...]  # start address and bytes of the code in scope
    cost_s: float

    @property
    def complete(self) -> bool:
        """Every instruction of the kernel's invocation was stepped."""
        return all(stratum.profile.complete for stratum in self.strata)

    @property
    def instructions(self) -> float:
        """Executed in scope; estimated where the profile is not complete."""
        return sum(stratum.instructions for stratum in self.strata)

    def in_words(self) -> str:
        """How the population of faults was found."""
        if self.complete:
            return f"all {self.instructions:.0f} executed instructions in scope"
        parts = [
            f"{len(s.profile.segments)} of {s.profile.windows_in_run} calls of {s.symbol}"
            for s in self.strata
        ]
        return f"cluster sample, {' + '.join(parts)}; about {self.instructions:.3g} instructions"

    def code_at(self, address: int) -> bytes:
        """16 bytes of code."""
        for start, data in self.code:
            if start <= address < start + len(data):
                return data[address - start : address - start + 16]
        return b""

    def draw(self, place: Place, plan: Strategy, rng: np.random.Generator) -> InstructionFault:
        """One fault, uniform over the executed instructions."""
        shares = np.array([stratum.instructions for stratum in self.strata])
        stratum = self.strata[int(rng.choice(len(shares), p=shares / shares.sum()))]
        locate = place.layout.image.locate
        return draw_fault(stratum.profile, plan, rng, code_at=self.code_at, locate=locate)


def profile_kernel(
    place: Place, rng: np.random.Generator, *, windows: int, inner: bool = False
) -> KernelProfile:
    """Step a fault-free run of the kernel, or a sample of it.

    Args:
        place: where it runs.
        rng: draws the windows.
        windows: how many invocations of a function are stepped at most.
        inner: sample the functions inside, as the whole invocation is too long.

    Raises:
        TargetError: the kernel never enters its native code.
        WindowTooLong: too many instructions even so.
    """
    start = time.perf_counter()
    scope = place.layout.scope
    functions = scope.inner if inner else (scope.entry,)
    strata = [_stratum(place, function, rng, windows) for function in functions]
    found = tuple(stratum for stratum in strata if stratum is not None)
    if not found:
        raise TargetError(place.kernel, f"never calls {scope.entry}")
    return KernelProfile(strata=found, code=_code(place), cost_s=time.perf_counter() - start)


def _stratum(
    place: Place, function: Location, rng: np.random.Generator, windows: int
) -> Stratum | None:
    start = time.perf_counter()
    image = place.layout.image
    tracee = place.start()
    try:
        count = tracee.count_to_end(image.address(function))
    finally:
        tracee.kill()
    if not count:
        return None
    drawn = rng.choice(count, size=min(windows, count), replace=False)
    segments = tuple(_window(place, Stage(function, int(number) + 1)) for number in sorted(drawn))
    profile = Profile(segments=segments, windows_in_run=count, cost_s=time.perf_counter() - start)
    return Stratum(
        function=function, symbol=_short(image.symbol(function) or function.object), profile=profile
    )


def _window(place: Place, stage: Stage) -> Segment:
    image = place.layout.image
    tracee = place.start()
    try:
        if not tracee.run_to(image.address(stage.location), stage.count):
            raise TargetError(place.kernel, "does not repeat its function calls")
        trace = record_window(
            tracee,
            scope_of(image, place.layout.scope.objects),
            limit=STEPS,
            program=place.kernel,
            until_return=True,
        )
    finally:
        tracee.kill()
    return Segment(start=(stage,), trace=trace)


def _code(place: Place) -> tuple[tuple[int, bytes], ...]:
    tracee = place.start()
    try:
        spans = scope_of(place.layout.image, place.layout.scope.objects).spans
        return tuple((s.start, tracee.read_memory(s.start, len(s) + 16)) for s in spans)
    finally:
        tracee.kill()


def _short(symbol: str) -> str:
    """The plain name of a function in a mangled one: the last part of its qualified name."""
    mangled = symbol.partition("+")[0]
    for size in re.finditer(r"\d+", mangled):
        end = size.end() + int(size.group())
        name = mangled[size.end() : end]
        if name[:1].islower() and mangled[end : end + 1] in ("E", "I"):
            return name
    return mangled or "its entry"
