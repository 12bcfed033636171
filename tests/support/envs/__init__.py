"""Environments whose returns or faults are known, and the best controller of one that comes with millrace."""
