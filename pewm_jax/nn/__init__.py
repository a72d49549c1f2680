"""Functional layers that the networks share: linear maps, attention, convolutions, positions."""
