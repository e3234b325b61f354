"""mavfi: what a bit flip does to a flying robot, and what it costs to survive it."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("mavfi")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
