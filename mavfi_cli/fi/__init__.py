"""Fault injection: bit operations, fault records, and the instruction-level injector."""
