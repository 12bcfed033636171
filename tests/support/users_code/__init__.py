"""What a user could have written: environments, policies and encoders, good and bad ones."""
