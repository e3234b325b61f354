"""The companion computer: nodes in simulated time, their kernels, and the gate that guards them."""
