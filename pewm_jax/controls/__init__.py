"""Controls: cameras and actions as conditioning of the denoiser."""
