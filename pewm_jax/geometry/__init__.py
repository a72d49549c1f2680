"""Cameras, actions and poses, Plücker rays, z-buffers, depth images, rays through voxel grids."""
