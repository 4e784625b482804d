"""Exact mathematics on float64 tensors: no networks, no input or output."""
