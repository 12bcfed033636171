"""Monitoring: shows runs to people, and sends their metrics to other programs. It only reads what the core reports."""
