"""Tests of the documentation: links, commands, names and code blocks of README.md and docs/."""
