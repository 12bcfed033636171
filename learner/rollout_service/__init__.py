"""What collects rollouts: the service, the specification of its workers, and its saved state."""
