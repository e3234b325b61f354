"""Record of a flight: run folder, tables, events and statistics."""
