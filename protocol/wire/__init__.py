"""Frames, arrays and sockets: how messages travel."""
