"""A PX4-like autopilot as pure logic: turns MAVLink messages into messages and setpoints.

It has no socket, no clock and no randomness. Every stamp is an argument, so the same messages at
the same stamps give the same answers, byte for byte.
"""
