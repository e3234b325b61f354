"""Instruction-level fault injection into native code of a running process (Linux)."""
