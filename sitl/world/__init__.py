"""Worlds: boxes on a flat ground, with a start and a goal; the same for the same seed.

`load_world` takes a name (`world_names()`), a generator spec `gen:density,size`, or the path of
a TOML file, and gives a `World`.
"""

from sitl.world.load import load_world, world_names
from sitl.world.world import World

__all__ = ["World", "load_world", "world_names"]
