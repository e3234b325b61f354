"""How one mission becomes a process: slots on this machine and on a cluster, and what ends mean.

run -> seats   the protocol: places where missions fly
       local   slots on this machine: template -> slot -> task, watched over by the keeper
       cluster the same on dask.distributed; remote is the worker's side
       verdict what the end of a mission's process means
"""
