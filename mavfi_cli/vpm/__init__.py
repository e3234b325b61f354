"""The visual performance model: how much speed and flight time a computer's mass and power cost."""
