"""Messages without sockets: fakes of both ends, and messages that nobody should send."""
