"""Makes a command line from a record: a field is a flag, its type is the check, the text under it is the help."""
