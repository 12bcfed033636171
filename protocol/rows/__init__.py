"""What the arrays of rows must be."""
