"""Who may connect: keys, tokens, the handshake."""
