"""The settings of a run, merged from defaults, presets, files and flags into one record."""
