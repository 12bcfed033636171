"""What makes the documentation site out of docs/, the code and some files of the repository (`make site`)."""
