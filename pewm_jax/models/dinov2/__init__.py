"""Networks of the family dinov2."""
