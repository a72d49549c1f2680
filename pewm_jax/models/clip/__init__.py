"""Networks of the family clip."""
