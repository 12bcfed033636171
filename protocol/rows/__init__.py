"""Checks of the arrays of rows."""
