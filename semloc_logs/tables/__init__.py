"""Parquet tables and their contracts, and files that appear complete or not at all."""
