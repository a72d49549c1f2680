"""Networks of the family cosmos."""
