"""Error against work on the same scenes in several engines. `python -m tests.benchmarks.work_precision --help`."""
