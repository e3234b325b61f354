"""Statistics of campaigns: pure functions of numbers, no files, no ledger.

proportions   success rates and their intervals, sample sizes
paired        the same missions under two treatments; families of tests
bootstrap     intervals of means, medians and paired differences
worst_case    the paper's worst case and its recovery
layers        from a kernel's silent corruption to the loss of a vehicle
"""
