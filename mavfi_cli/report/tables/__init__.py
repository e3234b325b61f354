"""Output of commands: text tables of at most 100 columns, and CSV."""
