"""Statistics: pure functions of numbers, without flights, files or ledgers.

shares      proportions and their intervals, also of sampled clusters; sample sizes; from an SDC of
            a kernel to lost missions
paired      the same missions under two treatments; families of tests; the paper's worst case;
            differences and recovered shares with intervals, and what they say about a claim
bootstrap   intervals of means, medians and paired differences
roc         detection against false alarms, over all thresholds

If SciPy has a statistic, the tests compare it with ours, to 1e-12. SciPy is not needed at run time,
because its import takes longer than any of these and records must keep their digits.
"""
