"""The running vehicle: autopilot, physics, camera and referee behind MAVLink endpoints."""
