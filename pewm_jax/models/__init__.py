"""The networks: video transformers, autoencoders, image encoders and networks of metrics."""
