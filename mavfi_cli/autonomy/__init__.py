"""The companion's kernels: perception, planning and control as pure steps.

point_cloud -> occupancy -> collision        perception
planners -> shortcut -> smoothing            planning
tracking                                     control

Importing this package is cheap; each kernel module brings numba or a native library with it.
"""

from __future__ import annotations


def is_compiled() -> bool:
    """Whether `warm_up` finds its kernels compiled; else it takes many seconds."""
    from mavfi_cli.autonomy.tracking import track  # the last one that it calls
    from mavfi_cli.core.compiled import in_cache

    return in_cache(track)


def warm_up() -> None:
    """Load (or compile, the first time on a machine) every kernel, so that no tick is slow."""
    from mavfi_cli.autonomy.warm import run_every_kernel

    run_every_kernel()
