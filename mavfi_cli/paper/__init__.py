"""The paper's tables, figures and claims: their missions, and our numbers next to the paper's.

items     the tables and figures: their missions, table columns and printed numbers
flying    flies the missions and runs the isolated kernels
layouts   the rows of each item's table, from flights
figures   the figure of each item
status    the tables and the state of one campaign
sources   reads campaigns, exports and runs of isolated kernels from folders
claims    every claim of the paper and its range
measures  the number that decides a claim, from flights or isolated kernels
verdicts  the comparison of an effect with the range of a claim
settling  further missions for undecided claims
answers   the sentences of the page's first screen
beyond    faults from kernel to mission, harm by bit, failures per hour, what mechanisms save
document  the content of the results page as plain values
"""
