"""Environments that come with millrace. Importing a module here registers its ids with gymnasium."""
