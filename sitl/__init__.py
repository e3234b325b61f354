"""The vehicle side: world, physics, flight controller, camera and referee behind MAVLink."""
