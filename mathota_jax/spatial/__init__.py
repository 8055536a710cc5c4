"""Vectors, quaternions and rotations in worlds-last layout: every component is its own array."""
