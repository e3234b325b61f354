"""Turn the ledger of a campaign into one table, and evaluate it.

flights      the table, one row per flight; its export to a file; one mission
pairs        flights beside their golden flights and their flights without detector; harm
summary      flights by setting; results of a campaign
failures     faults that fail missions, across the layers; the summary of attacked kernels
overhead     cost of detection and recovery
platforms    comparison of platforms: ratios, cost of faults, worst cases
detectors    detection, false alarms and recovery, over pairs of flights
scores       traces replayed through detectors; samples for training
beside_model the performance model beside its flights
timeline     from one depth frame to its setpoint
trajectories the flights of one picture
"""
