"""Turn the ledger of a campaign into one table, and evaluate it.

flights      the table, one row per flight; its export to a file; one mission
pairs        flights matched with their golden and their unprotected flights; harm
summary      flights by setting; results of a campaign
failures     missions that fail because of faults, across the layers
kernels      the summary of attacked kernels
overhead     cost of detection and recovery
platforms    comparison of platforms: ratios, cost of faults, worst cases
detectors    detection, false alarms and recovery, over pairs of flights
scores       traces replayed through detectors; samples for training
beside_model the performance model compared with its flights
timeline     from one depth frame to its setpoint
trajectories the flights of one mission, for a picture
"""
