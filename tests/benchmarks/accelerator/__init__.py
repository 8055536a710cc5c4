"""Thousands of worlds on whatever device JAX finds, beside MJX and MuJoCo Warp."""
