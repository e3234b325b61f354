"""The companion computer: nodes in simulated time, their kernels, and the detector's gate."""
