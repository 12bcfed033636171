"""Several learner processes for one run. They divide each batch's shards among them, and add gradients in a fixed order."""
