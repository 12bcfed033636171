"""Everything that a run does between two updates: counting, writing files, reporting and evaluating."""
