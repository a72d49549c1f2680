"""EgoWM: a video diffusion model steered by actions."""
