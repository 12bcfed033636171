"""Fast updates of small networks: a pass or a term of a loss is one node of autograd's graph, an optimizer step one call."""
