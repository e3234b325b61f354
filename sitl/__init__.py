"""The simulated vehicle: world, physics, flight controller, camera and referee behind MAVLink."""
