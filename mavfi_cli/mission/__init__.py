"""The composition root: link + autonomy (+ faults + detectors), one clock and one loop."""
