"""The systems that the experiments compare, one module each."""
