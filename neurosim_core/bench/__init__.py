"""Benchmarks: what the product says about its own speed and errors."""
