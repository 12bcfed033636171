"""Makes a command line from a record: each field is a flag, its type checks the value, the string under it is the help."""
