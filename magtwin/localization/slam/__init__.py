"""Magnetic SLAM without a map: a reduced-rank Gaussian process of the field, estimated with the poses."""
