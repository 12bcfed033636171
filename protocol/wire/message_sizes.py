"""How large a message may be. The bounds of the fields in its head are in `millrace.protocol.bounds`.

Rule: the socket refuses a frame that is too large before it reads any of it; the codec checks the other limits before it
unpacks anything.
"""

from __future__ import annotations

MAX_FRAME_BYTES = 1 << 30
MAX_FRAMES = 256  # a description has two frames for each array of a space
MAX_HEAD_BYTES = 1 << 20
MAX_ITEMS = 1 << 16  # items in a list or map of a worker's message; in the learner's messages, MAX_HEAD_BYTES bounds them
MAX_DIMENSIONS = 8
