"""Networks of the family nomad."""
