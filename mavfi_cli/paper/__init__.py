"""The paper's tables, figures and claims: what is flown for them, and our numbers beside its own.

items     the tables and figures, their missions, the form of their tables, the paper's numbers
flying    flies the missions and runs the isolated kernels
layouts   the rows of each item's table, from flights
figures   the figure of each item
status    what a campaign shows of the paper, and its state
sources   campaigns, exports and runs of isolated kernels, found in folders
claims    every claim of the paper, its range, and the measures of flights that decide it
beyond    from kernel to mission, where a bit hurts, failures an hour, what a mechanism saves
document  all of it as plain values, for the page
"""
