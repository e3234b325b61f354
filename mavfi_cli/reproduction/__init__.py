"""The paper's tables and figures: what is flown for them, and our numbers beside the paper's.

items    the items, their missions, the form of their tables, and the paper's numbers
flying   flies the missions and runs the isolated kernels; tells the cost before
flights  flown missions as one table, each beside the flights that it is compared with
layouts  the rows of each item's table, from flights
figures  the figure of each item
status   what a campaign shows of the paper, and its state
"""
