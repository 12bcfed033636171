"""Monitoring: what shows runs to people and to other programs. All of it reads what the core tells, and changes nothing."""
