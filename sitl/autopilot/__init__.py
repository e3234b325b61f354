"""A PX4-like autopilot as pure logic: turns received messages into replies and setpoints.

It has no socket, clock or randomness: the same messages at the same stamps give the same answers.
"""
