"""What detectors are worth: flights that training never saw, with and without them.

plan      which missions are flown
fly       flies them, and reads what came of them
pairs     golden, faulty and protected flights of one mission side by side
metrics   detection, false alarms, latency, recovery, from pairs
scores    traces once more through the detectors, without their thresholds
curves    receiver operating characteristic, precision and recall
evaluate  all of it: one table of plain values
table     the same as lines of text, and as rows
"""
