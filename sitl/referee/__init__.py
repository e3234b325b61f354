"""The referee, which knows the true state and detects collisions."""

from sitl.referee.referee import Collision, Referee

__all__ = ["Collision", "Referee"]
