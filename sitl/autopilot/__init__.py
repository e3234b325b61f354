"""A PX4-like autopilot as pure logic: MAVLink messages in, messages and setpoints out.

No socket, no clock, no randomness: every stamp is an argument, so that the same messages at the
same stamps give the same answers, byte for byte.
"""
