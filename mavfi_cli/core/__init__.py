"""Types, frames, state table, seeds, errors, configuration. Imports numpy; numba on first use."""
