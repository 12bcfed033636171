"""Settings of a run: from defaults, presets, files and flags to one record."""
