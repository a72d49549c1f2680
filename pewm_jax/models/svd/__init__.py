"""Networks of the family svd."""
