"""Statistics: pure functions of numbers that know no flight, no file and no ledger.

shares      proportions and their intervals, sample sizes
paired      the same missions under two treatments; families of tests
bootstrap   intervals of means, medians and paired differences
worst_case  the paper's worst case and its recovery
roc         detection against false alarms, over all thresholds
layers      from a kernel's silent corruption to the loss of a vehicle

Where SciPy has the same statistic, the tests hold ours against it, to 1e-12. SciPy is not needed at
run time: its import takes longer than any of these, and records keep the digits that they have.
"""
