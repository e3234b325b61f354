"""The visual performance model: what the mass and power of compute cost in speed and time."""
