"""Several learner processes for one run. They share the shards of each batch, and add gradients in a fixed order."""
