"""The worker processes that fly a campaign's missions.

base     the interface of workers
local    workers on this machine
cluster  workers on dask.distributed; remote is the code on their side
task     the work of a worker
verdict  the meaning of the end of a mission's process
"""
