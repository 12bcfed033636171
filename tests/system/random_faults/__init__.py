"""Many faults at random times, for as long as one likes: the soak, and runs that are killed and resumed."""
