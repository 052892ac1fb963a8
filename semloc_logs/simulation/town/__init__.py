"""Roads, ground, plots and rooms: worlds put together from meshes."""
