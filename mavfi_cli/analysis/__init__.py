"""Turn the ledger of a campaign into one table, and evaluate it.

flights      the table, one row per flight; its export to a file; pairs of its rows
groups       flights by setting; summary: results of a campaign
failures     faults that fail missions, across the layers
kernel_runs  the summary of attacked kernels
overhead     cost of detection and recovery
platforms    comparison of platforms: ratios, cost of faults, worst cases
detectors    detection, false alarms, recovery, of the pairs that detector_pairs makes
scores       traces replayed through detectors
timeline     from one depth frame to its setpoint
trajectories the flights of one picture
"""
