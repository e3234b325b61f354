"""The paper's tables and figures: what is flown for them, and our numbers beside the paper's.

items     the items, the form of their tables, and the paper's numbers, from paper.toml
plan      the missions of items as one list
flying    flies them, and has the kernels run; tells the cost before
kernels   the runs of isolated kernels
flights   flown missions as one table, each beside the flights that it is compared with
measures  numbers of flights as cells of a table
layouts   the rows of each item's table
figures   the figure of each item
status    what a campaign shows of the paper, and its state
"""
