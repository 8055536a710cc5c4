"""Speed against error, measured beside peers in the same run. `python -m tests.benchmarks --help`."""
