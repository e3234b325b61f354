"""What a flight leaves: the run folder, its tables, its events, and what is counted from them."""
