"""What a training will cost, before it starts: FLOPs, memory, time, the best mesh."""
