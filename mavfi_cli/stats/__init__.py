"""Statistics: pure functions of numbers, without flights, files or ledgers.

shares      proportions and their intervals, also for sampled clusters; sample sizes; the
            probability that an SDC of a kernel fails the mission
paired      the same missions under two treatments; families of tests; the paper's worst case;
            differences and recovered shares with intervals, and the verdict on a claim
bootstrap   intervals of means, medians and paired differences
sequences   tests and intervals that hold at any number of looks
strata      allocation and weighted rates of stratified samples
roc         detection against false alarms, over all thresholds

Quantiles, exact tests, the bootstrap and permutations come from SciPy, which is imported inside the
functions because its import takes a second.
"""
