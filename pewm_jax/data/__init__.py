"""Datasets: scenes and their renderer, collecting and importing episodes, checks, the loader."""
