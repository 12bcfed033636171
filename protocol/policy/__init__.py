"""The policy: parameter layout, acting in numpy and in torch."""
