"""What commands print: tables of text in at most 100 columns, and rows of CSV."""
