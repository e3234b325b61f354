"""What flown campaigns say about the paper's claims, and what the paper does not ask.

sources    campaigns, exports and runs of isolated kernels, found in folders
flights    one flight of a campaign, and the golden flights of a set
effects    lost and longer missions, and pairs of flights, as numbers with intervals
catalogue  every claim of the paper, with the range that it gives
findings   the number that decides each claim
beyond     from kernel to mission, where a bit hurts, failures an hour
arms       what each mechanism of a stack saves
items      the paper's tables and figures, from flights of any campaign
document   all of it as plain values, for the page
"""
