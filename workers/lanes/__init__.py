"""Lanes: env copies that are stepped together, and the one piece of code that steps a policy over them."""
