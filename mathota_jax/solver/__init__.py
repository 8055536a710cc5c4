"""Projected Gauss-Seidel on rows; it knows neither contacts nor joints."""
