"""Arithmetic that knows neither logs nor maps: transforms, bits, small matrices, local shape."""
