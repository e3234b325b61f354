"""Anomaly detection on the states between kernels (paper, section V); imports core only."""
