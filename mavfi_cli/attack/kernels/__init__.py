"""One kernel of the autonomy at a time, one bit flip a run, and what became of its output."""
