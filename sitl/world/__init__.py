"""Worlds: boxes on flat ground with a start and a goal. The same seed gives the same world."""

from sitl.world.world import World, load_world, named_worlds

__all__ = ["World", "load_world", "named_worlds"]
