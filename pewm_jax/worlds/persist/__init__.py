"""PERSIST: a world model whose state is a voxel grid."""
