"""Bodies in worlds-last form, their free motion and their integration."""
