"""Chapter 8, planning: how it decides."""
