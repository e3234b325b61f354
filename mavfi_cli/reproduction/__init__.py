"""The paper's tables and figures: what each needs, how it looks, and what the paper printed."""
