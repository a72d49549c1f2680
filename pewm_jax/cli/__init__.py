"""The last chapter: the command ``pewm-jax``, of which train.py and evaluate.py are shells."""
