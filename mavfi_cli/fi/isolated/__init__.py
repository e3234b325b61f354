"""Isolated campaigns: golden run, then one fault a run, and what became of the output."""
