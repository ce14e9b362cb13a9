"""Benchmarks of each part, with limits of the machine measured in the same run: `make bench`."""
