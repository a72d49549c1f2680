"""Predict what a training needs before it starts: FLOPs, memory, time and the best mesh."""
