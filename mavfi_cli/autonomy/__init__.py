"""The companion's kernels: perception, planning and control as pure step functions.

point_cloud -> occupancy -> collision        perception
planners -> shortcut -> smoothing            planning
tracking                                     control

Importing this package is cheap. Each kernel module imports numba or a native library.
"""

from __future__ import annotations

OUR_PLANNERS = ("rrtstar", "rrt", "rrtconnect")


def canonical_planner(name: str) -> str:
    """Return the canonical name of a planner, under which records and groups list it.

    For our own planners, case, hyphens, underscores and the star of RRT* do not matter. Any other
    name is returned unchanged.
    """
    plain = name.lower().replace("*", "star").replace("-", "").replace("_", "")
    return plain if plain in OUR_PLANNERS else name


def is_compiled() -> bool:
    """Return True if all kernels are compiled. Otherwise `warm_up` takes many seconds."""
    from mavfi_cli.autonomy.tracking import track  # the last kernel that `warm_up` calls
    from mavfi_cli.core.compiled import in_cache

    return in_cache(track)


def warm_up() -> None:
    """Load every kernel, or compile it the first time on a machine, so that no tick is slow."""
    from mavfi_cli.autonomy.warm import run_every_kernel

    run_every_kernel()
