"""Programs of a user's own over worker processes: `RolloutService` and the vector environment."""
