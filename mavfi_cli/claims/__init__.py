"""What flown campaigns say about the paper's claims, and what the paper does not ask.

sources   finds campaigns, exports and runs of isolated kernels in folders
flights   one flight of a campaign as the counts below need it
effects   lost and longer missions, and pairs of flights, as numbers with intervals
claims    every claim of the paper, and its verdict
beyond    from kernel to mission, where a bit hurts, failures an hour, what each check saves
document  all of it as plain values, for the page
"""
