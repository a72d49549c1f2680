"""Networks of the family cogvideox."""
