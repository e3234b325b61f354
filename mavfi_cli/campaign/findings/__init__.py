"""What a campaign has found: its missions gathered, compared, summarised, drawn and exported."""
