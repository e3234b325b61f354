"""The depth camera: ray casting against the world's boxes, served as a MAVLink camera."""
