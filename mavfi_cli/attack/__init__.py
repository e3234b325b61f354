"""Attacks on native code: one driver for kernels, nodes, programs and plug-ins."""
