"""Summaries, tables, CSV and pictures."""
