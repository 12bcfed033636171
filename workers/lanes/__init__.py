"""Lanes: env copies that are stepped together, and the only code that steps them with a policy's actions."""
