"""Rigid transforms, bits, small matrices and local shape: arithmetic that knows nothing of logs or
maps.
"""
