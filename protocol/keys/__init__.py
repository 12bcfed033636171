"""Who may connect: keys, tokens, the CURVE handshake."""
