"""The command line `millrace COMMAND`: `main` runs the command, and the other modules contain flags and commands."""
