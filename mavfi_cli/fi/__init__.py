"""Fault injection: bit operations, the source-level injector and the instruction-level tracer."""
