"""Measures the speed and memory of millrace and of its peers. Each benchmark prints a table and writes JSON."""
