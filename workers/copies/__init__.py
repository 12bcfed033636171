"""Env copies: N environments behind one interface, and the code that reads and checks what they return."""
