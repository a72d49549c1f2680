"""Diffusion: kinds of noise, prediction targets, samplers."""
