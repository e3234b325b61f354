"""The visual performance model: the cost of compute mass and power in speed and flight time."""
