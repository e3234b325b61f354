"""Worlds: boxes on flat ground with a start and a goal. The same seed gives the same world.

`load_world` takes a name (`named_worlds()`), a generator spec `gen:density,size`, or the path of a
TOML file, and returns a `World`.
"""

from sitl.world.world import World, load_world, named_worlds

__all__ = ["World", "load_world", "named_worlds"]
