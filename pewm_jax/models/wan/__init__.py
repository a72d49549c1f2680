"""Networks of the family wan."""
