"""The companion's kernels: perception, planning and control as pure step functions.

point_cloud -> occupancy -> collision        perception
planners -> shortcut -> smoothing,           planning
                        minimum_snap
tracking                                     control

Importing this package is cheap. Each kernel module imports numba or a native library.
"""

from __future__ import annotations

OUR_PLANNERS = ("rrtstar", "rrt", "rrtconnect")
SMOOTHERS = ("ours", "release")


def canonical_planner(name: str) -> str:
    """Return the canonical name of a planner, which records and groups use.

    For our own planners, case, hyphens, underscores and the star of RRT* do not matter. Any other
    name is returned unchanged.
    """
    plain = name.lower().replace("*", "star").replace("-", "").replace("_", "")
    return plain if plain in OUR_PLANNERS else name
