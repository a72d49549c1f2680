"""Chapter 5, how the model imagines: kinds of noise, prediction targets, samplers."""
