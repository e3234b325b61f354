"""What flown campaigns say about the paper's claims, and what the paper does not ask.

sources    campaigns, exports and runs of isolated kernels, found in folders
catalogue  every claim of the paper, its range, and the measures of flights that decide it
beyond     from kernel to mission, where a bit hurts, failures an hour, what a mechanism saves
items      the paper's tables and figures, from flights of any campaign
document   all of it as plain values, for the page
"""
