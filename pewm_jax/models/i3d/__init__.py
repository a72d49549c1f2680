"""Networks of the family i3d."""
