"""Monitoring: shows runs to people and to other programs. It only reads what the core reports."""
