"""Turn the ledger of a campaign into one table, and evaluate the flights in it.

flights      the table, one row per flight; its export to a file; the row of one mission
pairs        each flight matched with its golden and its unprotected flight; harm
summary      the results of a campaign, by setting
failures     missions that fail because of faults, compared with SDCs of isolated kernels
kernels      the summary of faults in isolated kernels
overhead     cost of detection and recovery
platforms    comparison of platforms: ratios, cost of faults, worst cases
detectors    detection, false alarms and recovery, over pairs of flights
scores       traces replayed through detectors; samples for training
beside_model the performance model compared with flights
timeline     kernel invocations from one depth frame to its setpoint
trajectories the flights of one mission, for a picture
"""
