"""Source-level faults: bit flips in the states that one kernel hands to the next."""
