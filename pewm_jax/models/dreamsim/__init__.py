"""Networks of the family dreamsim."""
