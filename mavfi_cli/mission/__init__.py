"""Composition root: combines link, autonomy, faults and detectors in one loop with one clock."""
