"""Programs that use millrace as anybody would."""
