"""Chapter 3, the networks: codec, control, denoiser, memory readers, image encoder."""
