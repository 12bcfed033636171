"""Networks of the newer off-policy algorithms: bodies with batch normalization, heads of quantiles and of categories."""
