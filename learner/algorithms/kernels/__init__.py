"""What makes updates of small networks fast: a pass or a term of a loss is one node, a step of the optimizer one call."""
