"""Chapter 7b, what a training will cost before it starts: FLOPs, memory, time, the best mesh."""
