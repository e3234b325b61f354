"""The depth camera: casts rays against the world's boxes and serves a MAVLink camera."""
