"""The simulated quadrotor: profile, JSBSim model, flight controller, battery, energy and truth."""
