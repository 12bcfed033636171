"""What tests of real processes stand on: hosts, networks, learners and workers, and what their runs leave behind."""
