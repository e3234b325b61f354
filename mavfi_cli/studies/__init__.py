"""Studies: the missions that answer a question, and their analysis."""
