"""Real firmware on the simulated vehicle: PX4 and ArduPilot fly it by their own simulator links."""
