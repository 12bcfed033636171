"""The replay buffers of off-policy algorithms: how transitions are stored and drawn."""
