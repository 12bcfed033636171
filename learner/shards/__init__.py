"""More than one learner process: shards of a batch, whose gradients are added in a fixed order."""
