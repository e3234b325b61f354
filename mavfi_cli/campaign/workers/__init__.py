"""The processes that fly a campaign's missions, and what their ends mean.

base     what the runner knows of workers
local    workers on this machine
cluster  the same on dask.distributed; remote is the side of its workers
task     what a worker does
verdict  what the end of a mission's process means
"""
