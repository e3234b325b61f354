"""Lets PX4 or ArduPilot fly the simulated vehicle, over the firmware's own simulator link."""
