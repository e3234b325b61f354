"""What a person reads and looks at: summaries and pictures of runs."""
