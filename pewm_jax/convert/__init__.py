"""The last chapter, other people's weights in, ours out."""
