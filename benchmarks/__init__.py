"""What millrace costs, and what its peers cost: each module prints a table and writes JSON."""
