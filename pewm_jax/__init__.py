"""Persistent embodied world models in JAX."""
