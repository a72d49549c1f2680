"""Networks of the family persist."""
