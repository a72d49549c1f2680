"""Chapter 3, the networks: codec, layers, diffusion transformer, memory blocks, world model."""
