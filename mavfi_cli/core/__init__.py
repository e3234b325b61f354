"""Types, frames, states table, seeds, errors and configuration; needs numpy only."""
