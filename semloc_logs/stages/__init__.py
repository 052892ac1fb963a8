"""The stages of the pipeline: each reads files of the one before and writes its own."""
