"""The referee: it alone knows the truth, and says what the vehicle hit, when and where."""

from sitl.referee.referee import Collision, Referee

__all__ = ["Collision", "Referee"]
