"""The command line `millrace COMMAND`: one module reads the command, others hold what is long."""
