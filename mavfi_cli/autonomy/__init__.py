"""The companion's kernels: perception, planning and control as pure step functions.

point_cloud -> occupancy -> collision        perception
planners -> shortcut -> smoothing,           planning
                        minimum_snap
tracking                                     control

Importing this package is cheap, but each of its kernel modules loads numba or a native library.
"""

from __future__ import annotations

OUR_PLANNERS = ("rrtstar", "rrt", "rrtconnect")
SMOOTHERS = ("ours", "release")


def canonical_planner(name: str) -> str:
    """Return a planner's canonical name, which is used in records and to group runs.

    For our own planners, case, hyphens and underscores do not matter, and `*` stands for `star`.
    Any other name is returned unchanged.
    """
    plain = name.lower().replace("*", "star").replace("-", "").replace("_", "")
    return plain if plain in OUR_PLANNERS else name
