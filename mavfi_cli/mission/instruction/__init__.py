"""Instruction-level faults in a mission: plan, profile, injection, and the attacked node."""

PROGRAM = "mavfi_cli.mission.instruction.server"  # of the attacked node
