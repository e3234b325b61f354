"""Attacks on native code, one fault a run: one driver for kernels, nodes, programs and plug-ins."""
