"""A campaign's ledger as one table of columns, and the questions that are asked of it.

flights      the table: a row a flight; as a file
groups       flights by setting; comparison, summary: what a campaign has found
pairs        two treatments of the same missions, row beside row
failures     faults that fail missions, across the layers
overhead     what detection and recovery cost
costs        what faults cost, and the worst cases; platforms: beside other computers
detectors    detection, false alarms, recovery; scores: traces once more through detectors
timeline     from one depth frame to its setpoint
trajectories which flights belong into one picture
"""
