"""Chapter 2, what it saw: scenes, renderer, trajectories, the episode format, import, loader."""
