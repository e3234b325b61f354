"""Turn the ledger of a campaign into one table, and evaluate it.

flights      the table, one row per flight; its export to a file
groups       flights by setting; comparison, summary: results of a campaign
pairs        two treatments of the same missions, row by row
failures     faults that fail missions, across the layers
overhead     cost of detection and recovery
costs        cost of faults, and worst cases; platforms: comparison of platforms
detectors    detection, false alarms, recovery; scores: traces replayed through detectors
timeline     from one depth frame to its setpoint
trajectories the flights of one picture
"""
