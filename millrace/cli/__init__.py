"""The command line `millrace COMMAND`: `main` runs the command, and the other modules hold flags and longer commands."""
