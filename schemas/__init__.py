"""Contracts as files: Parquet columns, message definitions, settings, label spaces. Imports nothing of ours."""
