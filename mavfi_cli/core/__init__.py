"""Types, frames, states table, seeds, errors, configuration; imports numpy only (numba on use)."""
