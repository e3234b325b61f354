"""Reports on flights and campaigns: text, tables, CSV, HTML and pictures."""
