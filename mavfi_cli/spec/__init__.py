"""Configuration of mission, fault, detector, stack and platform, as plain values."""
