"""Files: atomic writing, tensor files, weights that ship with the package."""
