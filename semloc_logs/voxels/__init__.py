"""Semantic occupancy fusion; blocks and voxels as Parquet."""
