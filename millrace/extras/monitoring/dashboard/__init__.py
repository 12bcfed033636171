"""A web page over run folders and running learners."""
