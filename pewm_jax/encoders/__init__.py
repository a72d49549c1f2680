"""Image encoders, whose features the memory stores."""
