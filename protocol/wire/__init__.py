"""Frames, arrays and sockets: how messages are sent."""
