"""The flight controller: position, velocity, attitude and rate loops, and the mixer."""
