"""Worlds: boxes on flat ground with a start and a goal. The same seed gives the same world.

`load_world` takes a name (`world_names()`), a generator spec `gen:density,size`, or the path of a
TOML file, and returns a `World`.
"""

from sitl.world.load import load_world, world_names
from sitl.world.world import World

__all__ = ["World", "load_world", "world_names"]
