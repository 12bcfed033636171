"""Everything that a run does between two updates: it counts, writes, tells and evaluates."""
