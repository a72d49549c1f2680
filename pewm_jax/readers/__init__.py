"""Memory readers: how the memory conditions the denoiser."""
