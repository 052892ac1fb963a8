"""Triangle meshes of what stands in a town."""
