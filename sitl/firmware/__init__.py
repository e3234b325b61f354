"""Real firmware flies the simulated vehicle: PX4 or ArduPilot, over its own simulator link."""
