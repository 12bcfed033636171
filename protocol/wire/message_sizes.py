"""How large a message may be. Bounds of the fields in its head: `millrace.protocol.bounds`.

Rule: the socket refuses a frame that is too large before it reads a byte of it; the codec refuses the rest before it unpacks
anything.
"""

from __future__ import annotations

MAX_FRAME_BYTES = 1 << 30
MAX_FRAMES = 256  # a description has two for each array of a space
MAX_HEAD_BYTES = 1 << 20
MAX_ITEMS = 1 << 16  # in a list or map of a worker's message; the learner's messages are bounded by the head
MAX_DIMENSIONS = 8
