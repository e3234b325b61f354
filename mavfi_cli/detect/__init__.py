"""Anomaly detection on inter-kernel states (paper, section V). Imports core only."""
