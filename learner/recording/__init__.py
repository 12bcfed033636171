"""Episodes of a policy, recorded: Minari datasets and videos."""
