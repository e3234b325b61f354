"""Attacks on one kernel of the companion at a time, with one fault per run."""
