"""Networks for the newer off-policy algorithms: bodies with batch normalization, and heads for quantiles and categories."""
