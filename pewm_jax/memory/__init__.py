"""Chapter 4, what is remembered: image features, the voxel map and its rivals, map tokens."""
