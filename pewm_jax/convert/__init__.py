"""Conversion of weights: import of published checkpoints, and exports."""
