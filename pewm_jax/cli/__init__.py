"""The command ``pewm-jax``; train.py and evaluate.py call it."""
