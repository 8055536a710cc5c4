"""Rows: what contacts and joints hand to the solver."""
