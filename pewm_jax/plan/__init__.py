"""Predict the requirements of a training run in advance: FLOPs, memory, time and the best mesh."""
