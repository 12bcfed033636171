"""Measures an environment and recommends settings for a run, with the speed to expect: `millrace.plan`."""
