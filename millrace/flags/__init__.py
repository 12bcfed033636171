"""A command line is made of a record: each field is a flag, its type is the check, and the text under it is the help."""
