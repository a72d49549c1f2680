"""PEWM: a video diffusion model with a 3D memory."""
