"""Statistics as pure functions of numbers, without access to flights, files or ledgers.

shares      proportions and their intervals, also for sampled clusters; sample sizes; the
            probability that an SDC in a kernel makes the mission fail
paired      the same missions under two treatments; families of tests; the paper's worst case;
            differences and recovered shares with intervals
bootstrap   intervals of means, medians and paired differences
sequences   tests and intervals that stay valid at any number of looks
strata      allocation of stratified samples, and their weighted rates
roc         detection rate against false-alarm rate, over all thresholds

Quantiles, exact tests, the bootstrap and permutations come from SciPy, which is imported inside the
functions because its import takes a second.
"""
