"""The referee, which knows the true state and detects collisions."""
