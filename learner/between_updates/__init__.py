"""Everything that a run does between two updates: it counts, writes files, reports and evaluates."""
