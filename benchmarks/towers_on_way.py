r"""Counts the towers near the straight line from start to goal, in the worlds of the first seeds.

    python benchmarks/towers_on_way.py sparse --seeds 200 --within 2

Prints, for each number of towers within a horizontal distance of the line, how many worlds have
that number, and the seeds of the worlds with the most towers.
"""

from __future__ import annotations

import argparse
import collections

import numpy as np

from sitl.world.world import distance_to_boxes, load_world

STEPS = 500  # points on the line


def towers(world: str, seed: int, within_m: float) -> int:
    """Return how many boxes of a world are within a distance of the line from start to goal.

    The distance is horizontal, in metres.
    """
    scene = load_world(world, seed=seed)
    if not len(scene.boxes_enu_m):
        return 0
    shares = np.linspace(0.0, 1.0, STEPS + 1)[:, None]
    points = scene.start_enu_m + shares * (scene.goal_enu_m - scene.start_enu_m)
    distances = [distance_to_boxes(scene.boxes_enu_m, point, plan=True) for point in points]
    return int((np.min(distances, axis=0) < within_m).sum())


def main() -> None:
    """Count the towers in all worlds, and print the counts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("world", help="sparse, dense, or another world that has seeds")
    parser.add_argument("--seeds", type=int, default=200, help="seeds 1 to this one")
    parser.add_argument("--within", type=float, default=2.0, help="distance from the line, m")
    given = parser.parse_args()
    seeds: dict[int, list[int]] = collections.defaultdict(list)
    for seed in range(1, given.seeds + 1):
        seeds[towers(given.world, seed, given.within)].append(seed)
    for count, worlds in sorted(seeds.items()):
        print(f"{count} towers: {len(worlds)} of {given.seeds} worlds")
    print(f"seeds of the last line: {', '.join(map(str, seeds[max(seeds)]))}")


if __name__ == "__main__":
    main()
