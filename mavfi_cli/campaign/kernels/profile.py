"""The population of faults of a kernel: what it executes, completely or by windows, in words."""

from __future__ import annotations

import numpy as np

from mavfi_cli.campaign.kernels.place import Place
from mavfi_cli.fi.isolated.profile import TargetProfile, Watch, profile_run
from mavfi_cli.fi.symbols import short_name


def profile_kernel(
    place: Place,
    rng: np.random.Generator,
    *,
    windows: int,
    sampled: bool = False,
    watch: Watch | None = None,
) -> TargetProfile:
    """Step a fault-free run of the kernel, or a sample of it.

    Args:
        place: where it runs.
        rng: draws the windows.
        windows: how many are stepped, at least, of those that begin at the same function.
        sampled: cut the run into windows, as it is too long to be stepped.
        watch: is told how far it is.

    Raises:
        TargetError: the kernel never enters its native code.
        WindowTooLong: too many instructions.
    """
    scope = place.layout.scope
    markers = (scope.inner or (scope.entry,)) if sampled else ()
    return profile_run(place, rng, markers=markers, windows=windows, watch=watch)


def in_words(profile: TargetProfile) -> str:
    """How the population of faults was found."""
    if profile.complete:
        return f"all {profile.instructions:.0f} executed instructions in scope"
    parts = []
    for stratum in profile.strata:
        windows = stratum.profile
        if stratum.marker is None:
            parts.append("the beginning")
            continue
        name = short_name(profile.image.symbol(stratum.marker) or stratum.marker.object)
        parts.append(f"{len(windows.segments)} of {windows.windows_in_run} windows from {name}")
    return (
        f"about {profile.instructions:.3g} executed instructions in scope, by sample: "
        f"{', '.join(parts)}; {profile.executed} stepped"
    )
