"""Chapter 2b, what was seen: scenes, renderer, trajectories, episodes, import, loader."""
