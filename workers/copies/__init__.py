"""Env copies: N environments behind one interface, and what they return, read and checked."""
