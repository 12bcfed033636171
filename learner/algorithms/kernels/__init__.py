"""Fast updates for small networks. A whole pass is one node of autograd's graph, and an optimizer step is one call."""
