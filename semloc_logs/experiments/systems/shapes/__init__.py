"""Descriptors of shape in place of ours, in the pipeline of the paper."""
