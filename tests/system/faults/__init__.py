"""One fault in each test: of a process, of the network, or a peer that means harm."""
