"""Networks of the family lpips."""
