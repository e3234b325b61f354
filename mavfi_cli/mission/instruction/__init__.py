"""Instruction-level faults in a mission: plan, profile, injection, and the attacked node."""
