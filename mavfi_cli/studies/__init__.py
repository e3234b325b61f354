"""Studies: which missions are flown for a question, and what is asked of them."""
