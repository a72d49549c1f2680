"""Memories of a scene: voxel map, images, points, surfels, 2D map, and their image features."""
