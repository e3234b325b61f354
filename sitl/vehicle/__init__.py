"""The simulated quadrotor: profile, JSBSim model, battery, energy and truth."""
