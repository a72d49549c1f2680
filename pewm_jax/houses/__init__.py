"""Procedural houses: floor plans, furniture, textures."""
