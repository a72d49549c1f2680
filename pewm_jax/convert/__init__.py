"""Conversion of weights: other people's in, ours out."""
