"""Chapter 2a, worlds we make: floor plans, furniture, textures."""
