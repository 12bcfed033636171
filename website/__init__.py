"""Builds the documentation site from docs/, the code and some files of the repository (`make site`)."""
