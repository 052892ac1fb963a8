"""Triangle meshes of the objects in a town."""
