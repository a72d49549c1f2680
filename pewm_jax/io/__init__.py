"""File input and output: atomic writes, tensor files, weights, resumable results, progress."""
